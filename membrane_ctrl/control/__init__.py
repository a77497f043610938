"""The loops: pure and clock-free, so that they run in a test, in a replay and in the twin alike."""
