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
_LEAST_VALUES = 20


@dataclass(frozen=True, slots=True)
class LocalLevel:
    """Result of the fit.

    Attributes
    ----------
    white : float
        Standard deviation of the noise.
    walk : float
        Variance of the walk per second; if no walk is seen, the largest that the data permit.
    seen : bool
        The data are much less likely without a walk.
    """

    white: float
    walk: float
    seen: bool


def fit_local_level(values: FloatArray, times_s: FloatArray) -> LocalLevel:
    """Fit white noise on a random walk.

    Parameters
    ----------
    values, times_s : (n,) arrays
        Readings and their times.

    Returns
    -------
    LocalLevel

    Raises
    ------
    ValueError
        There are fewer than 20 values.
    """
    if values.size < _LEAST_VALUES:
        raise ValueError(f"{values.size} values are too few to tell noise from drift: 20 at least")

    # The likelihood of each ratio of walk to noise.
    steps_s = np.diff(times_s)
    cycle_s = float(np.median(steps_s))
    fits = [_log_likelihood(values, steps_s / cycle_s, float(ratio)) for ratio in _RATIOS]
    likelihoods = np.array([fit[0] for fit in fits])
    best = int(np.argmax(likelihoods))
    variance = fits[best][1]

    # Without a walk that is seen: the largest ratio that is hardly less likely.
    seen = bool(likelihoods[best] - likelihoods[0] > _DROP)
    chosen = best
    if not seen:
        permitted = np.flatnonzero(likelihoods > likelihoods[best] - _DROP)
        chosen = int(permitted[-1])
    walk_per_s = float(_RATIOS[chosen]) * variance / cycle_s
    return LocalLevel(math.sqrt(variance), walk_per_s, seen)


def _log_likelihood(values: FloatArray, steps: FloatArray, ratio: float) -> tuple[float, float]:
    """Log likelihood and noise variance for a ratio, by the Kalman filter.

    Variances are in units of the noise's. The first value only initialises the filter.
    """
    level = float(values[0])
    spread = 1.0
    squares = 0.0
    logs = 0.0
    for value, step in zip(values[1:].tolist(), steps.tolist(), strict=True):
        # Predict: the walk widens the level's variance.
        spread += ratio * step
        expected = spread + 1.0

        # The innovation's share in the likelihood.
        off = value - level
        squares += off * off / expected
        logs += math.log(expected)

        # Update.
        gain = spread / expected
        level += gain * off
        spread *= 1.0 - gain

    # The noise's variance is concentrated out: its likeliest value for this ratio.
    count = values.size - 1
    variance = squares / count
    return -0.5 * (count * math.log(variance) + logs), variance
