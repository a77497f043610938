"""Colours of quantities in every plot: the palette of Okabe and Ito, which colour-blind readers can
distinguish.
"""

Colour = tuple[int, int, int]  # red, green, blue: 0 to 255

BLUE: Colour = (86, 180, 233)
ORANGE: Colour = (230, 159, 0)
GREEN: Colour = (0, 158, 115)
RED: Colour = (213, 94, 0)
VIOLET: Colour = (204, 121, 167)
YELLOW: Colour = (240, 228, 66)
# Colour maps of Matplotlib for heights and their changes, in page, report and measurement.
DIVERGING_MAP = "RdBu_r"  # blue below zero, red above
SEQUENTIAL_MAP = "viridis"

GREY: Colour = (140, 140, 140)
WHITE: Colour = (235, 235, 235)
