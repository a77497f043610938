"""Emulators: devices that answer in bytes, each with faults that can be switched on."""
