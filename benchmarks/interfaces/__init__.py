"""Benchmarks of device links, bridges and the web page."""
