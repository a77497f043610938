"""The control port of a running hold: requests, roles, sockets."""
