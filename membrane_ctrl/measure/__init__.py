"""Capture sets and their results."""
