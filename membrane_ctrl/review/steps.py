"""Steps in a noisy series: the mean behind a place against the mean before it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

Column = NDArray[np.float64]

# The noise is judged over stretches of this many values: weather changes over a night.
_STRETCH = 3600


@dataclass(frozen=True, slots=True)
class Step:
    """A step found.

    Attributes
    ----------
    row : int
        Place in the series.
    size : float
        After minus before, in the series' unit.
    sigmas : float
        Its size over the noise of such differences.
    """

    row: int
    size: float
    sigmas: float


def steps(values: Column, half: int, skip: int, least: float, least_sigmas: float) -> list[Step]:
    """Steps of at least `least` and `least_sigmas`, one for each that happened.

    Parameters
    ----------
    values : (n,) array
        Equally spaced; NaN where there is nothing, which no step crosses.
    half : int
        Values averaged on each side.
    skip : int
        Values left out between the sides: how long a step may take.
    least : float
        Unit of the values.
    least_sigmas : float
        Against the robust spread of the differences nearby.
    """
    difference = differences(values, half, skip)
    sigma = local_sigma(difference)
    size = np.nan_to_num(np.abs(difference))
    score = np.where(sigma > 0, size / np.maximum(sigma, 1e-300), np.inf)
    found = (size >= least) & (score >= least_sigmas)
    # the greatest within reach stands for all of one step
    reach = 2 * half + skip
    peak = found & (size >= ndimage.maximum_filter1d(size, 2 * reach + 1, mode="constant"))
    rows = np.flatnonzero(peak)
    if rows.size:
        rows = rows[np.concatenate(([True], np.diff(rows) > reach))]
    return [Step(int(row), float(difference[row]), float(score[row])) for row in rows]


def differences(values: Column, half: int, skip: int) -> Column:
    """(n,) mean of the `half` values behind a place minus that of those before it; NaN at the ends and at gaps."""
    result = np.full(values.size, np.nan)
    span = 2 * half + skip
    if values.size < span:
        return result
    windows = np.lib.stride_tricks.sliding_window_view(np.asarray(values, dtype=np.float64), half).mean(axis=1)
    middle = half + skip // 2
    count = values.size - span + 1
    result[middle : middle + count] = windows[half + skip :][:count] - windows[:count]
    return result


def local_sigma(values: Column, share: float = 0.5) -> Column:
    """(n,) robust standard deviation of stretches of the series, constant within each, about 0.

    Parameters
    ----------
    values : (n,) array
    share : float
        Of the values that are nothing but noise: what this share of them keeps below is judged by a normal
        distribution. Half of them (the median) is the most robust, and blind to values that mostly repeat.
    """
    result = np.full(values.size, np.nan)
    sigmas = float(special.ndtri(0.5 * (1 + share)))
    for first in range(0, values.size, _STRETCH):
        # the last stretch is a full one, too
        start = max(0, min(first, values.size - _STRETCH))
        part = values[start : first + _STRETCH]
        part = np.abs(part[np.isfinite(part)])
        result[first : first + _STRETCH] = np.quantile(part, share) / sigmas if part.size else np.nan
    return result


def confidence(sigmas: float, looked_at: int) -> float:
    """1 minus the chance that noise alone (normal) makes a step this high anywhere in `looked_at` places."""
    return float(max(0.0, 1.0 - looked_at * special.erfc(sigmas / np.sqrt(2))))
