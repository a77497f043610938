"""Benchmarks of tuning sessions and pump surveys."""
