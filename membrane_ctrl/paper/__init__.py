"""The published measurement, computed again: each figure and table of the paper beside ours."""
