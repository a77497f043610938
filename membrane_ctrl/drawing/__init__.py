"""Plots as PNG pictures, drawn straight into arrays of pixels.

Matplotlib makes an object of every tick and label: 32 small plots take it two seconds and another
half to load. What `measure` shows needs lines, bands, bars, maps and their colour scales only.
"""
