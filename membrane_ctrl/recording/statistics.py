"""Statistics of a run of any length in a fixed amount of memory."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]


class Moments:
    """Mean and standard deviation of values that come in batches.

    Batches are merged by the pairwise update of Chan, Golub and LeVeque (1979): with n, m the counts, d the
    difference of the means and S the sums of squared deviations,

        mean = mean_n + d m / (n + m),    S = S_n + S_m + d^2 n m / (n + m),

    which does not cancel when the mean is large against the deviation.
    """

    def __init__(self) -> None:
        self.count = 0
        self.mean = 0.0
        self._squares = 0.0

    def add(self, values: Values) -> None:
        """Take in a batch; values that are not finite are left out."""
        values = values[np.isfinite(values)]
        if not values.size:
            return
        mean = float(values.mean())
        delta = mean - self.mean
        total = self.count + values.size
        self._squares += float(((values - mean) ** 2).sum()) + delta**2 * self.count * values.size / total
        self.mean += delta * values.size / total
        self.count = total

    @property
    def std(self) -> float:
        """Standard deviation about the mean (divisor n, as `numpy.std`); NaN without values."""
        return math.sqrt(self._squares / self.count) if self.count else math.nan


class LogHistogram:
    """Quantiles of positive values from bins of equal ratio.

    Parameters
    ----------
    low, high : float
        Range; values outside are counted in the first or last bin.
    ratio : float
        Upper edge over lower edge of a bin. A quantile is given as its bin's geometric middle, so its relative
        error is at most sqrt(ratio) - 1.

    Attributes
    ----------
    count : int
    largest : float
        Exact; NaN without values.
    """

    def __init__(self, low: float = 1e-3, high: float = 1e5, ratio: float = 1.02) -> None:
        self._low = low
        self._log_ratio = math.log(ratio)
        self._bins = np.zeros(math.ceil(math.log(high / low) / self._log_ratio), dtype=np.int64)
        self.count = 0
        self.largest = math.nan

    def add(self, values: Values) -> None:
        """Take in a batch; values that are not finite are left out."""
        values = values[np.isfinite(values)]
        if not values.size:
            return
        places = np.log(np.maximum(values, self._low) / self._low) / self._log_ratio
        places = np.clip(places.astype(np.int64), 0, self._bins.size - 1)
        self._bins += np.bincount(places, minlength=self._bins.size)
        self.count += values.size
        self.largest = float(np.fmax(self.largest, values.max()))

    def quantile(self, share: float) -> float:
        """The value that `share` of all values do not exceed; NaN without values."""
        if not self.count:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self._bins), share * self.count))
        return self._low * math.exp((place + 0.5) * self._log_ratio)


class SecondMeans:
    """Means over consecutive windows of one second; a window with a gap in it gives none.

    Attributes
    ----------
    count, inside : int
        Windows so far, and those whose mean is within `band`.
    first, last : float
        Mean of the first and of the latest window; NaN before there is one.
    """

    def __init__(self, band: float, window_s: float = 1.0, gap_s: float = 0.5) -> None:
        self._band = band
        self._window_s = window_s
        self._gap_s = gap_s
        self._start_s = math.nan
        self._latest_s = math.nan
        self._sum = 0.0
        self._rows = 0
        self.count = 0
        self.inside = 0
        self.first = math.nan
        self.last = math.nan

    def add(self, time_s: float, value: float) -> None:
        """Take in one value; times rise."""
        if not time_s - self._latest_s <= self._gap_s:
            self._begin(time_s)
        elif time_s - self._start_s >= self._window_s:
            self._close()
            self._begin(time_s)
        self._latest_s = time_s
        self._sum += value
        self._rows += 1

    def _begin(self, time_s: float) -> None:
        self._start_s = time_s
        self._sum = 0.0
        self._rows = 0

    def _close(self) -> None:
        mean = self._sum / self._rows
        self.count += 1
        self.inside += abs(mean) <= self._band
        self.first = mean if self.count == 1 else self.first
        self.last = mean
