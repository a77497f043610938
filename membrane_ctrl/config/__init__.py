"""The configuration: its tables, and the TOML file it comes from."""
