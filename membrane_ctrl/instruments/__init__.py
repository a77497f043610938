"""Devices from the configuration, with one program per device."""
