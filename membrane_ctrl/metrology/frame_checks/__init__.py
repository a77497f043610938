"""Frames that do not belong to their set are found and left out."""
