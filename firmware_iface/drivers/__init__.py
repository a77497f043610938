"""Drivers: one file per device, each of which fills a role of `roles.py`."""
