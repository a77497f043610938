"""The panel as a picture of its own pixels, with the dark grid between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.worlds.second_optics.patterns import PERIOD_MM, PERIODS, Picture

Singles = NDArray[np.float32]

PIXELS = 768  # of the panel, along each side of the pattern
SIDE_MM = PERIODS * PERIOD_MM
LEVELS = 255  # of an 8-bit panel
TEXELS = 4  # of a pixel along each side; the last one is the grid
GRID_LIGHT = 0.3  # of the grid, of its pixel: three texels of four and this are the fill factor
LEAK = 0.002  # of a black pixel, of white: contrast 500 : 1


def pixel_levels(picture: Picture) -> Singles:
    """Light of the panel's pixels (768, 768) by row along s_y and column along s_x, 0..1."""
    centres_mm = (((np.arange(PIXELS) + 0.5) / PIXELS - 0.5) * SIDE_MM).astype(np.float32)
    s_x_mm, s_y_mm = np.meshgrid(centres_mm, centres_mm)
    level = np.rint(LEVELS * picture.level(s_x_mm, s_y_mm)) / LEVELS
    return np.asarray(LEAK + (1 - LEAK) * level, np.float32)


def panel_texture(pictures: list[Picture]) -> Singles:
    """Three pictures as the three colours of one texture (3072, 3072, 3)."""
    cell = np.ones((TEXELS, TEXELS), np.float32)
    cell[-1, :] = GRID_LIGHT
    cell[:, -1] = GRID_LIGHT
    return np.stack([np.kron(pixel_levels(picture), cell) for picture in pictures], axis=-1)
