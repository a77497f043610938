"""Drivers: one file a device, each fills a role of `roles.py`."""
