"""The mirror calibrates its own optics: one geometry for many sets of different sag
(docs/how-to/calibration.md).
"""
