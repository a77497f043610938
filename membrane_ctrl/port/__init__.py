"""The control port: how people and programs talk to a running hold (docs/control-port.md)."""
