"""The law of the membrane under pressure, and a film's material from its figures."""
