"""The files of a run: their formats, and opening a run."""
