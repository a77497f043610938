"""Everything that knows a byte: the register map, links, drivers and emulators of devices."""
