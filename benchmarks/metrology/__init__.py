"""Benchmarks of cameras, frames, reconstruction, calibration and tracking."""
