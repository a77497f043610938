"""Tuning by hand: what gains would do, on the fitted plant and in the recorded weather."""
