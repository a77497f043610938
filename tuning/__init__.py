"""Tuning sessions: identify the plant, design the gains, verify them."""
