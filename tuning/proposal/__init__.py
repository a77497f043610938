"""Gains from a model, and their verification."""
