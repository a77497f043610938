"""The colour scale of a map, and the numbers that stand beside it."""

from __future__ import annotations

import numpy as np

from membrane_ctrl.drawing.axis_scale import AxisScale, Spacing
from membrane_ctrl.model.arrays import FloatArray

# Largest value of a map over that of 99 % of it, beyond which a linear scale would hide the rest.
_STEEP = 3.0
_TYPICAL_PERCENTILES = (0.5, 99.5)
_LEAST_SCALE = 1e-12


def choose_map_colours(values: FloatArray, shown: FloatArray, even: bool) -> AxisScale:
    """Return a scale from typical values, which single cells at the edge do not set.

    Parameters
    ----------
    values : (n, n) array
        The map; NaN where nothing is known.
    shown : (m, m) array
        The cells of it that are drawn.
    even : bool
        Centre the scale on 0; values far beyond those of the rest of the map make it logarithmic
        beyond these.
    """
    low, high = np.percentile(shown[np.isfinite(shown)], _TYPICAL_PERCENTILES)
    if not even:
        return AxisScale(float(low), float(max(high, low + _LEAST_SCALE)))
    high = max(abs(low), abs(high), _LEAST_SCALE)
    most = max(high, float(np.nanmax(np.abs(_local_mean(values)))))
    if most > _STEEP * high:
        return AxisScale(-most, most, Spacing.SYMMETRIC, high)
    return AxisScale(-most, most)


def describe_map(values: FloatArray) -> str:
    """Peak to valley of a map (rows, columns), and its RMS about its mean, in its own unit; NaN
    cells do not count.
    """
    known = values[np.isfinite(values)]
    return f"PV {np.ptp(known):.3g}\nRMS {np.std(known):.3g}"


def _local_mean(values: FloatArray) -> FloatArray:
    """Mean over squares of 3 x 3 cells: a single wild cell does not set a scale."""
    whole = [size // 3 * 3 for size in values.shape]
    squares = values[: whole[0], : whole[1]].reshape(whole[0] // 3, 3, whole[1] // 3, 3)
    return np.asarray(squares.mean(axis=(1, 3)))
