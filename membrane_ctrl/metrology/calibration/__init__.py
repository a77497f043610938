"""Self-calibration: the bench's geometry from capture sets of the mirror."""
