"""From the configuration to devices, one program a device."""
