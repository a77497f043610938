"""Holds a pneumatic membrane mirror to the micrometre and measures its optical figure while it does so."""

__version__ = "0.1.0"
