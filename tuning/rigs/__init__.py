"""Benches and holds that a session drives."""
