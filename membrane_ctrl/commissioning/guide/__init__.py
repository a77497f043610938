"""`commission`: a guided session from the mirror's data to an accepted hold."""
