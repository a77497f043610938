"""Colour maps as tables of 256 colours, under the names that Matplotlib gives them."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]

_STEPS = 256
# ColorBrewer's diverging scheme of eleven classes, from blue to red (colorbrewer2.org, RdBu).
_BLUE_TO_RED = (
    (5, 48, 97),
    (33, 102, 172),
    (67, 147, 195),
    (146, 197, 222),
    (209, 229, 240),
    (247, 247, 247),
    (253, 219, 199),
    (244, 165, 130),
    (214, 96, 77),
    (178, 24, 43),
    (103, 0, 31),
)


@cache
def colour_table(name: str) -> Pixels:
    """Return a colour map.

    Parameters
    ----------
    name : {"RdBu_r", "viridis", "magma", "gray"}
        Matplotlib's name of the map.

    Returns
    -------
    (256, 3) array
        Red, green and blue, from the lowest value to the highest.

    Raises
    ------
    KeyError
        There is no table of this name.
    """
    steps = np.arange(_STEPS, dtype=np.uint8)
    if name == "gray":
        return np.repeat(steps[:, None], 3, axis=1)
    if name == "RdBu_r":
        places = np.linspace(0, 1, len(_BLUE_TO_RED))
        shares = np.linspace(0, 1, _STEPS)
        channels = np.array(_BLUE_TO_RED, float).T
        table = np.stack([np.interp(shares, places, channel) for channel in channels], axis=1)
        return np.asarray(np.rint(table), np.uint8)
    map_number = {"viridis": cv2.COLORMAP_VIRIDIS, "magma": cv2.COLORMAP_MAGMA}[name]
    table = cv2.applyColorMap(steps[:, None], map_number).reshape(_STEPS, 3)
    return np.array(table[:, ::-1], np.uint8)  # OpenCV counts blue, green, red
