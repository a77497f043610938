"""Links: how bytes get to a device and back, and which answers are accepted."""
