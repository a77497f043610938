"""The loops: pure and clock-free, so that a test, a replay and the twin run the same code."""
