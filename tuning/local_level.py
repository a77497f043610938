"""White noise on a random walk, at any times: how much of each, and how much walk the data still permit.

The likelihood of the local level model by its Kalman filter, with the noise's variance concentrated out, over the
ratio of walk to noise. Source: Durbin and Koopman, Time Series Analysis by State Space Methods (2012), chapter 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_RATIOS = np.geomspace(1e-9, 10.0, 61)  # variance of the walk in a cycle over that of the noise
_DROP = 2.0  # of the log likelihood: 95 % on one side, and some for the grid


@dataclass(frozen=True, slots=True)
class LocalLevel:
    """What was found.

    Attributes
    ----------
    white : float
        Standard deviation of the noise.
    walk : float
        Variance of the walk a second; where no walk is seen, the most that the data permit.
    seen : bool
        The data are much less likely without a walk.
    """

    white: float
    walk: float
    seen: bool


def fit_local_level(values: NDArray[np.float64], times_s: NDArray[np.float64]) -> LocalLevel:
    """Fit the model. Raises ValueError for fewer than 20 values."""
    if values.size < 20:
        raise ValueError(f"{values.size} values are too few to tell noise from drift: 20 at least")
    steps_s = np.diff(times_s)
    cycle_s = float(np.median(steps_s))
    fits = [_likelihood(values, steps_s / cycle_s, float(ratio)) for ratio in _RATIOS]
    likely = np.array([fit[0] for fit in fits])
    best = int(np.argmax(likely))
    seen = bool(likely[best] - likely[0] > _DROP)
    chosen = best if seen else int(np.flatnonzero(likely > likely[best] - _DROP)[-1])
    variance = fits[best][1]
    return LocalLevel(math.sqrt(variance), float(_RATIOS[chosen]) * variance / cycle_s, seen)


def _likelihood(values: NDArray[np.float64], steps: NDArray[np.float64], ratio: float) -> tuple[float, float]:
    """Log likelihood and the noise's variance for a ratio; the first value only starts the filter."""
    level, spread = float(values[0]), 1.0
    squares = logs = 0.0
    for value, step in zip(values[1:].tolist(), steps.tolist(), strict=True):
        spread += ratio * step
        expected = spread + 1.0
        off = value - level
        squares += off * off / expected
        logs += math.log(expected)
        gain = spread / expected
        level += gain * off
        spread *= 1.0 - gain
    count = values.size - 1
    variance = squares / count
    return -0.5 * (count * math.log(variance) + logs), variance
