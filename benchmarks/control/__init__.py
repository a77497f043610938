"""Benchmarks of the loops, the controller and whole holds."""
