"""Who is told when nobody looks at the screen (docs/control-port.md, alarms)."""
