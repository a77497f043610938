"""Frames of a set, and whether they belong together."""
