"""Vibrations of the mirror, from tracked figures."""
