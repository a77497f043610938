"""Alarms: which are sent, to whom, and when they are repeated (docs/control-port.md, alarms)."""
