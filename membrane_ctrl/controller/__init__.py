"""The tick: states, safety, commands, and what a controller remembers. Pure."""
