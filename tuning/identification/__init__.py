"""Models of plant and disturbance from a record."""
