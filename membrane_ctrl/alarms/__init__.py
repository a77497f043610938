"""Alarms: which are sent, to whom, and when they are repeated (docs/reference/control-port.md,
alarms)."""
