"""The twin's optics: exact ray tracing, and the frames that a camera would take."""
