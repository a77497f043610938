"""White noise on a random walk: the amount of each, and the largest walk that the data permit.

The likelihood of the local level model by its Kalman filter, at any times, with the noise's
variance concentrated out, over the ratio of walk to noise.
Source: Durbin and Koopman, Time Series Analysis by State Space Methods (2012), chapter 2.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

_RATIOS = np.geomspace(1e-9, 10.0, 61)  # variance of the walk per cycle over that of the noise
_DROP = 2.0  # of the log likelihood: 95 % one-sided, with some margin for the grid


@dataclass(frozen=True, slots=True)
class LocalLevel:
    """Result of the fit."""

    white: float  # standard deviation of the noise
    # variance of the walk per second; if no walk is seen, the largest that the data permit
    walk: float
    seen: bool  # the data are much less likely without a walk


def fit_local_level(values: FloatArray, times_s: FloatArray) -> LocalLevel:
    """Fit the model. Raises ValueError for fewer than 20 values."""
    if values.size < 20:
        raise ValueError(f"{values.size} values are too few to tell noise from drift: 20 at least")
    steps_s = np.diff(times_s)
    cycle_s = float(np.median(steps_s))
    fits = [_log_likelihood(values, steps_s / cycle_s, float(ratio)) for ratio in _RATIOS]
    likely = np.array([fit[0] for fit in fits])
    best = int(np.argmax(likely))
    seen = bool(likely[best] - likely[0] > _DROP)
    chosen = best if seen else int(np.flatnonzero(likely > likely[best] - _DROP)[-1])
    variance = fits[best][1]
    return LocalLevel(math.sqrt(variance), float(_RATIOS[chosen]) * variance / cycle_s, seen)


def _log_likelihood(values: FloatArray, steps: FloatArray, ratio: float) -> tuple[float, float]:
    """Log likelihood and noise variance for a ratio; the first value
    only initialises the filter.
    """
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
