"""Detection of unreported events in a run."""
