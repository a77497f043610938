"""The figure from every frame of a crossed pattern (docs/tracking.md)."""
