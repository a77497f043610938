"""Statistics of a run of any length in constant memory."""

import copy
import math

import numpy as np

from membrane_ctrl.model.arrays import Column, FloatArray

Values = FloatArray


class Moments:
    """Mean and standard deviation of values that arrive in batches.

    Batches are merged by the pairwise update of Chan, Golub and LeVeque (1979): with n, m the
    counts, d the difference of the means and S the sums of squared deviations,

        mean = mean_n + d m / (n + m),    S = S_n + S_m + d^2 n m / (n + m),

    which avoids cancellation when the mean is large compared with the deviation.
    """

    def __init__(self) -> None:
        self.count = 0
        self.mean = 0.0
        self._squares = 0.0

    def add(self, values: Values) -> None:
        """Add a batch, ignoring values that are not finite."""
        values = values[np.isfinite(values)]
        if not values.size:
            return
        mean = float(values.mean())
        delta = mean - self.mean
        total = self.count + values.size
        self._squares += (
            float(((values - mean) ** 2).sum()) + delta**2 * self.count * values.size / total
        )
        self.mean += delta * values.size / total
        self.count = total

    @property
    def std(self) -> float:
        """Standard deviation about the mean (divisor n, as `numpy.std`); NaN without values."""
        return math.sqrt(self._squares / self.count) if self.count else math.nan


class LogHistogram:
    """Quantiles of positive values from bins of equal ratio between `low` and `high`, with one more
    bin beyond each.

    A quantile is its bin's geometric middle, so its relative error is at most sqrt(ratio) - 1;
    `largest` is exact.
    """

    def __init__(self, low: float = 1e-3, high: float = 1e5, ratio: float = 1.02) -> None:
        self._low = low
        self._log_ratio = math.log(ratio)
        self._bins = np.zeros(math.ceil(math.log(high / low) / self._log_ratio), dtype=np.int64)
        self.count = 0
        self.largest = math.nan

    def add(self, values: Values) -> None:
        """Add a batch, ignoring values that are not finite."""
        values = values[np.isfinite(values)]
        if not values.size:
            return
        places = np.log(np.maximum(values, self._low) / self._low) / self._log_ratio
        places = np.clip(places.astype(np.int64), 0, self._bins.size - 1)
        self._bins += np.bincount(places, minlength=self._bins.size)
        self.count += values.size
        self.largest = float(np.fmax(self.largest, values.max()))

    def quantile(self, share: float) -> float:
        """The value not exceeded by `share` of all values; NaN without values."""
        if not self.count:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self._bins), share * self.count))
        return self._low * math.exp((place + 0.5) * self._log_ratio)


# A window with fewer of its ticks than this says nothing of its length.
_LEAST_SHARE = 0.9


def least_ticks(window_s: float, rate_hz: float) -> float:
    """Ticks that a window must have: nine tenths, or all but one, which may have come just behind
    its end.
    """
    ticks = window_s * rate_hz
    return min(_LEAST_SHARE * ticks, ticks - 1)


class SecondMeans:
    """Means of the seconds of the run that have at least `least` values; `result` is that of all
    until now.
    """

    def __init__(self, band: float, least: float) -> None:
        self._band = band
        self._least = least
        self._second = self._count = self._sum = 0.0  # of the last second, which may go on
        self._means = Moments()
        self._inside = 0
        self._first = self._last = math.nan

    def add(self, time_s: Column, values: Column) -> None:
        """Take in (n,) values at their times, which rise;
        those that are not finite are left out.
        """
        there = np.isfinite(values)
        second = np.append(self._second, np.floor(time_s[there] + 1e-9))
        starts = np.flatnonzero(np.diff(second, prepend=np.nan))
        counts = np.add.reduceat(np.append(self._count, np.ones(second.size - 1)), starts)
        sums = np.add.reduceat(np.append(self._sum, values[there]), starts)
        self._second, self._count, self._sum = float(second[-1]), float(counts[-1]), float(sums[-1])
        self._take(counts[:-1], sums[:-1])

    def _take(self, counts: Column, sums: Column) -> None:
        whole = counts >= self._least
        means = sums[whole] / counts[whole]
        self._means.add(means)
        self._inside += int((np.abs(means) <= self._band).sum())
        if means.size:
            self._first, self._last = (
                float(means[0]) if math.isnan(self._first) else self._first,
                float(means[-1]),
            )

    def result(self) -> dict[str, float]:
        """Number of seconds; mean, standard deviation, first and last of their means; share within
        the band.
        """
        all_of = copy.deepcopy(self)
        all_of._take(np.array([self._count]), np.array([self._sum]))
        count = all_of._means.count
        return {
            "seconds": count,
            "mean_um": all_of._means.mean if count else math.nan,
            "std_um": all_of._means.std if count > 1 else math.nan,
            "in_band": all_of._inside / count if count else math.nan,
            "first_um": all_of._first,
            "last_um": all_of._last,
        }
