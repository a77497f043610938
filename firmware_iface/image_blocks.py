"""Means of an image's square blocks, which have less noise than its pixels."""

import numpy as np
from numpy.typing import ArrayLike

from firmware_iface.arrays import FloatArray

_BLOCK_PX = 16  # the mean of 256 pixels has a sixteenth of their noise


def block_means(image: ArrayLike) -> FloatArray:
    """Means of square blocks without incomplete ones at the edges; for small images the pixels
    themselves.
    """
    pixels = np.asarray(image, np.float64)
    side = max(1, min(_BLOCK_PX, min(pixels.shape) // 8))
    rows, columns = (length // side for length in pixels.shape)
    blocks = pixels[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return np.asarray(blocks.mean(axis=(1, 3)))
