"""From light to counts, and from counts to the numbers of a file."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.worlds.second_optics.effects import Sensor

FloatArray = NDArray[np.float64]
Counts = NDArray[np.uint8] | NDArray[np.uint16]


def count(share: FloatArray, sensor: Sensor, rng: np.random.Generator) -> FloatArray:
    """Whole counts of a share of full scale: noise, response, clipping, rounding."""
    full = float(2**sensor.bits - 1)
    variance = (sensor.read_adu / full) ** 2
    if sensor.full_well:
        variance = variance + np.maximum(share, 0) / sensor.full_well
    share = share + np.sqrt(variance) * rng.standard_normal(share.shape)
    share = np.clip(share - sensor.black_clip, 0, 1)
    if sensor.response_gamma != 1:
        share = share ** (1 / sensor.response_gamma)
    return np.asarray(np.rint(full * share))


def store(counts: FloatArray, sensor: Sensor) -> Counts:
    """The numbers that the file has."""
    if sensor.bits == 8:
        if sensor.container == "video range":
            counts = np.clip(counts, 16, 235)
        return counts.astype(np.uint8)
    whole = counts.astype(np.uint16)
    if sensor.container == "left-aligned":
        return whole * np.uint16(2 ** (16 - sensor.bits))
    if sensor.container == "byte-swapped":
        return whole.byteswap()
    if sensor.container == "packed":
        return _packed(whole)
    return whole


def _packed(counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """12-bit pixels, two in three bytes, read as 16-bit ones; the end of the picture is missing."""
    first, second = counts.reshape(-1, 2).T.astype(np.uint32)
    stream = np.stack([first & 255, first >> 8 | (second & 15) << 4, second >> 4], axis=1)
    read = np.zeros(2 * counts.size, np.uint8)
    read[: stream.size] = stream.ravel().astype(np.uint8)
    return read.view(np.uint16).reshape(counts.shape)
