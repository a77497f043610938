"""Everything at byte level: the register map, links, drivers and emulators of devices."""
