"""The figure from every frame of a crossed pattern that stands still (docs/how-to/tracking.md)."""
