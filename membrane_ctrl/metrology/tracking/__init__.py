"""The figure from every frame of a crossed pattern (docs/how-to/tracking.md)."""
