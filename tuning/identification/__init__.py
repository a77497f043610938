"""From a record to a model of plant and disturbance."""
