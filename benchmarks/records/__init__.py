"""Benchmarks of the recorder and of the review of runs."""
