"""The figure of a capture set, and the numbers that describe it."""
