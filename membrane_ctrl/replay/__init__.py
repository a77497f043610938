"""Recorded inputs run again, and runs repaired."""
