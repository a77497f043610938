"""The process that owns screen and camera and runs the measurement cycle."""
