"""From a model to gains, and whether they keep what they promise."""
