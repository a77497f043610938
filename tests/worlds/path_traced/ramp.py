"""A panel whose colours tell the place: what a pixel of the camera sees, without patterns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.worlds.path_traced.panel_texture import SIDE_MM

FloatArray = NDArray[np.float64]


def ramp_texture() -> NDArray[np.float32]:
    """A panel of 256 x 256 that shows s_x, s_y and light as its colours."""
    ramp = ((np.arange(256) + 0.5) / 256).astype(np.float32)
    along_x, along_y = np.meshgrid(ramp, ramp)
    return np.stack([along_x, along_y, np.ones_like(along_x)], axis=-1)


def ramp_places_mm(image: FloatArray) -> FloatArray:
    """Places (2, rows, columns) on the screen from the light under `ramp_texture`."""
    light = np.maximum(image[:, :, 2], 1e-9)
    shares = np.stack([image[:, :, 0], image[:, :, 1]]) / light
    return (shares - 0.5) * SIDE_MM
