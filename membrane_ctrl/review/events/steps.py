"""Steps in a noisy series: the mean after a place compared with the mean before it."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage, special

from membrane_ctrl.model.arrays import Column

# The noise is estimated over stretches of this many values: weather changes over a night.
_STRETCH = 3600


@dataclass(frozen=True, slots=True)
class FoundStep:
    """A detected step."""

    row: int  # place in the series
    size: float  # after minus before, in the series' unit
    sigmas: float  # its size over the noise of such differences


def find_steps(
    values: Column, half: int, skip: int, least: float, least_sigmas: float
) -> list[FoundStep]:
    """Steps of at least `least` and `least_sigmas`, each once.

    Parameters
    ----------
    values : (n,) array
        Equally spaced; NaN for gaps, which no step crosses.
    half : int
        Values averaged on each side.
    skip : int
        Values skipped between the sides: the longest duration of a step.
    least : float
        In the unit of the values.
    least_sigmas : float
        Relative to the robust spread of nearby differences.
    """
    difference = mean_differences(values, half, skip)
    sigma = local_sigma(difference)
    size = np.nan_to_num(np.abs(difference))
    score = np.where(sigma > 0, size / np.maximum(sigma, 1e-300), np.inf)
    found = (size >= least) & (score >= least_sigmas)
    # the largest within reach represents the whole step
    reach = 2 * half + skip
    peak = found & (size >= ndimage.maximum_filter1d(size, 2 * reach + 1, mode="constant"))
    rows = np.flatnonzero(peak)
    if rows.size:
        rows = rows[np.concatenate(([True], np.diff(rows) > reach))]
    return [FoundStep(int(row), float(difference[row]), float(score[row])) for row in rows]


def mean_differences(values: Column, half: int, skip: int) -> Column:
    """How much the mean after each place differs from that before it.

    Parameters
    ----------
    values : (n,) array
        Values at equal distances; NaN in gaps.
    half : int
        Number of values before and after.
    skip : int
        Number of values between these two groups, which count for neither.

    Returns
    -------
    (n,) array
        NaN at the ends and at gaps.
    """
    result = np.full(values.size, np.nan)
    span = 2 * half + skip
    if values.size < span:
        return result

    # The mean of each group that begins at a place; those after a step begin `half + skip` later.
    windows = np.lib.stride_tricks.sliding_window_view(
        np.asarray(values, dtype=np.float64), half
    ).mean(axis=1)
    middle = half + skip // 2
    count = values.size - span + 1
    result[middle : middle + count] = windows[half + skip :][:count] - windows[:count]
    return result


def local_sigma(values: Column, share: float = 0.5) -> Column:
    """Return a robust standard deviation of stretches of a series about 0, constant within each.

    The quantile `share` of the absolute values is compared with that of a normal distribution. Half
    (the median) is the most robust, but fails for values that mostly repeat.

    Parameters
    ----------
    values : (n,) array
        The series; NaN values are left out.
    share : float
        The quantile to use, from 0 to 1.

    Returns
    -------
    (n,) array
    """
    result = np.full(values.size, np.nan)
    sigmas = float(special.ndtri(0.5 * (1 + share)))
    for first in range(0, values.size, _STRETCH):
        # the last stretch is full-length too
        start = max(0, min(first, values.size - _STRETCH))
        part = values[start : first + _STRETCH]
        part = np.abs(part[np.isfinite(part)])
        if part.size:
            result[first : first + _STRETCH] = np.quantile(part, share) / sigmas
        else:
            result[first : first + _STRETCH] = np.nan
    return result


def step_confidence(sigmas: float, looked_at: int) -> float:
    """Return 1 minus the probability that normal noise alone makes a step this high anywhere.

    Parameters
    ----------
    sigmas : float
        Height of the step in standard deviations.
    looked_at : int
        Number of places that were examined.
    """
    return float(max(0.0, 1.0 - looked_at * special.erfc(sigmas / np.sqrt(2))))
