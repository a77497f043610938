"""A straight line through correlated samples, with a confidence interval that allows for the
correlation.
"""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from membrane_ctrl.model.arrays import Column

# Iterations of g and of the variance absorbed by the line: three give short records the right
# coverage; more leave the shortest records no degree of freedom, and so a meaningless interval.
_BIAS_ROUNDS = 3
# Of the variance; beyond, the correction itself would dominate the correlation.
_TAKEN_MOST = 0.5


@dataclass(frozen=True, slots=True)
class FittedSlope:
    """Least-squares slope."""

    per_hour: float  # unit of the values per hour
    low: float  # 95 % confidence interval
    high: float
    effective_samples: float  # equivalent number of independent samples; NaN with too few values

    @property
    def is_significant(self) -> bool:
        """Whether 0 is outside the interval."""
        return bool(self.low > 0 or self.high < 0)


def fit_slope(time_s: Column, values: Column) -> FittedSlope:
    """Fit the slope of values against time, with an interval for correlated samples.

    The variance of the ordinary slope is multiplied by the integrated autocorrelation time of the
    residuals, g = 1 + 2 sum r_k, summed while the sums of neighbouring pairs stay positive and fall
    (Geyer 1992, initial monotone sequence); Student's t has the degrees of freedom that are left, n
    / g - 2. A line takes up part of a slow wander and makes g too small in short series: each of
    its two parameters takes g / n of the variance out of every r_k, which is put back, with g from
    the round before. An interval of 95 % then covers 94 to 97 % of long records, and 90 % of those
    of six correlation times.

    Parameters
    ----------
    time_s : (n,) array
        Equally spaced except for gaps.
    values : (n,) array
        In any unit; values that are not finite are ignored.

    Returns
    -------
    FittedSlope
        In the values' unit per hour; NaN with fewer than 5 finite values.
    """
    finite = np.isfinite(values)
    hours = time_s[finite] / 3600.0
    values = values[finite]
    if hours.size < 5 or np.ptp(hours) <= 0:
        return FittedSlope(np.nan, np.nan, np.nan, np.nan)
    # Ordinary least squares
    hours = hours - hours.mean()
    spread = float((hours**2).sum())
    rate = float((hours * values).sum()) / spread
    residual = values - values.mean() - rate * hours
    # Correlated samples count for fewer
    factor = correlation_time(residual)
    effective = values.size / factor
    freedom = max(effective - 2, 1.0)
    variance = float((residual**2).sum()) / (values.size - 2)
    sigma = np.sqrt(variance * effective / freedom * factor / spread)
    half_width = float(stats.t.ppf(0.975, freedom) * sigma)
    return FittedSlope(rate, rate - half_width, rate + half_width, effective)


def correlation_time(residual: Column) -> float:
    """1 + 2 sum of the autocorrelation of a series (n,), in samples; at least 1."""
    return correlation_times(residual)[0]


def correlation_times(residual: Column) -> tuple[float, float]:
    """1 + 2 sum of the autocorrelation, and of its square, for a variance; in samples,
    at least 1.

    Source: Geyer, Statistical Science 7 (1992) 473, initial monotone sequence; `fit_slope`
    describes the correction of the bias.
    """
    size = residual.size
    # Autocovariance by the Wiener-Khinchin theorem, padded against wrapping around
    power = np.abs(np.fft.rfft(residual, 2 * size)) ** 2
    covariance = np.fft.irfft(power)[:size]
    if covariance[0] <= 0:
        return 1.0, 1.0
    measured = covariance / covariance[0]
    factor = 1.0
    of_square = 1.0
    for _ in range(_BIAS_ROUNDS):
        # Put back the share of the variance that the fitted line has taken
        taken = min(2 * factor / size, _TAKEN_MOST)
        correlation = measured * (1 - taken) + taken
        # Sum while the sums of neighbouring pairs are positive, and let them only fall
        pairs = correlation[: size // 2 * 2].reshape(-1, 2).sum(axis=1)
        negative = np.flatnonzero(pairs <= 0)
        count = int(negative[0]) if negative.size else pairs.size
        total = np.minimum.accumulate(pairs[:count]).sum()
        total_of_square = (correlation[: 2 * count] ** 2).sum()
        factor = float(np.clip(2 * total - 1, 1.0, size / 3))
        of_square = float(np.clip(2 * total_of_square - 1, 1.0, size / 3))
    return factor, of_square
