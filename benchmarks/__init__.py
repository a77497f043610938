"""Measured figures, each against a reference of the same run: `make bench` or `python -m benchmarks [NAME...]`."""
