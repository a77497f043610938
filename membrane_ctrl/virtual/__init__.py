"""The controller in virtual time: the same tick over the twin, as fast as it goes."""
