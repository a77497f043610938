"""Replay of recorded inputs, and repair of runs."""
