"""Files of the optical geometry."""
