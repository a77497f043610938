"""Child processes and the memory they share."""
