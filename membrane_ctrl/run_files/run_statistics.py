"""Statistics of a run of any length in constant memory."""

import copy
import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from membrane_ctrl.model.arrays import Column, FloatArray, IntArray
from membrane_ctrl.model.state_tree import ArrayShape, Count, StateNode

Values = FloatArray
# Range and resolution of a histogram. The values are times in ms.
_LOWEST, _HIGHEST = 1e-3, 1e5
_BIN_RATIO = 1.02
_LOG_RATIO = math.log(_BIN_RATIO)
_BINS = math.ceil(math.log(_HIGHEST / _LOWEST) / _LOG_RATIO)
# A window with fewer of its ticks than this does not represent its length.
_LEAST_SHARE = 0.9


@dataclass(slots=True)
class Moments(StateNode):
    """Mean and standard deviation of values that arrive in batches.

    Batches are merged by the pairwise update of Chan, Golub and LeVeque (1979): with n, m the
    counts, d the difference of the means and S the sums of squared deviations,

        mean = mean_n + d m / (n + m),    S = S_n + S_m + d^2 n m / (n + m),

    which avoids cancellation when the mean is large compared with the deviation.
    """

    count: Count = 0
    mean: float = 0.0
    squares: float = 0.0  # sum of the squared deviations from the mean

    def add(self, values: Values) -> None:
        """Add a batch, ignoring values that are not finite."""
        values = values[np.isfinite(values)]
        if not values.size:
            return
        mean = float(values.mean())
        delta = mean - self.mean
        total = self.count + values.size
        self.squares += (
            float(((values - mean) ** 2).sum()) + delta**2 * self.count * values.size / total
        )
        self.mean += delta * values.size / total
        self.count = total

    @property
    def std(self) -> float:
        """Standard deviation about the mean (divisor n, as `numpy.std`); NaN without values."""
        if not self.count:
            return math.nan
        return math.sqrt(self.squares / self.count)


@dataclass(slots=True)
class LogHistogram(StateNode):
    """Quantiles of positive values from bins of equal ratio. The first and the last bin also count
    the values beyond them.

    A quantile is its bin's geometric middle, so its relative error is at most sqrt(ratio) - 1;
    `largest` is exact.
    """

    bins: Annotated[IntArray, ArrayShape((_BINS,), "<i8")] = field(
        default_factory=lambda: np.zeros(_BINS, dtype=np.int64)
    )
    count: Count = 0
    largest: float = math.nan

    def add(self, values: Values) -> None:
        """Add a batch, ignoring values that are not finite."""
        values = values[np.isfinite(values)]
        if not values.size:
            return
        places = np.log(np.maximum(values, _LOWEST) / _LOWEST) / _LOG_RATIO
        places = np.clip(places.astype(np.int64), 0, _BINS - 1)
        self.bins += np.bincount(places, minlength=_BINS)
        self.count += values.size
        self.largest = float(np.fmax(self.largest, values.max()))

    def find_quantile(self, share: float) -> float:
        """The value not exceeded by `share` of all values; NaN without values."""
        if not self.count:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self.bins), share * self.count))
        return _LOWEST * math.exp((place + 0.5) * _LOG_RATIO)


def count_least_ticks(window_s: float, rate_hz: float) -> float:
    """Return how many ticks a window must have: nine tenths, or all but one, which may have come
    just behind its end.

    Parameters
    ----------
    window_s : float
        Length of the window.
    rate_hz : float
        Ticks a second.
    """
    ticks = window_s * rate_hz
    return min(_LEAST_SHARE * ticks, ticks - 1)


@dataclass(slots=True)
class SecondMeans(StateNode):
    """Means of the seconds of the run that have at least `least` values; `result` is that of all
    until now.
    """

    band: float
    least: float
    # of the last second, which may be unfinished
    second: float = 0.0
    count: float = 0.0
    sum: float = 0.0
    means: Moments = field(default_factory=Moments)
    inside: Count = 0
    first: float = math.nan
    last: float = math.nan

    def add(self, time_s: Column, values: Column) -> None:
        """Add values at their times; those that are not finite are omitted.

        Parameters
        ----------
        time_s : (n,) array
            Rising, also from block to block.
        values : (n,) array
            The values.
        """
        finite = np.isfinite(values)
        # The second that is not complete yet goes before the new values
        second = np.append(self.second, np.floor(time_s[finite] + 1e-9))
        count = np.append(self.count, np.ones(second.size - 1))
        value = np.append(self.sum, values[finite])
        # Count and sum of each second; the last one may continue in the next block
        starts = np.flatnonzero(np.diff(second, prepend=np.nan))
        counts = np.add.reduceat(count, starts)
        sums = np.add.reduceat(value, starts)
        self.second = float(second[-1])
        self.count = float(counts[-1])
        self.sum = float(sums[-1])
        self._add_sums(counts[:-1], sums[:-1])

    def _add_sums(self, counts: Column, sums: Column) -> None:
        whole = counts >= self.least
        means = sums[whole] / counts[whole]
        self.means.add(means)
        self.inside += int((np.abs(means) <= self.band).sum())
        if means.size:
            if math.isnan(self.first):
                self.first = float(means[0])
            self.last = float(means[-1])

    def result(self) -> dict[str, float]:
        """Number of seconds; mean, standard deviation, first and last of their means; share within
        the band.
        """
        all_of = copy.deepcopy(self)
        all_of._add_sums(np.array([self.count]), np.array([self.sum]))
        count = all_of.means.count
        return {
            "seconds": count,
            "mean_um": all_of.means.mean if count else math.nan,
            "std_um": all_of.means.std if count > 1 else math.nan,
            "in_band": all_of.inside / count if count else math.nan,
            "first_um": all_of.first,
            "last_um": all_of.last,
        }
