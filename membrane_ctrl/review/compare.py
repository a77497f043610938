"""Two runs side by side, with the significance of each difference."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from membrane_ctrl.review.analysis import Analysis, Series
from membrane_ctrl.review.drift import Slope

Column = NDArray[np.float64]

# Five minutes forget the weather (30 s) and the air (300 s) well enough to count as independent; a short run is cut
# into eight, which makes its test a rough one.
_BLOCK_S = 300.0
_LEAST_BLOCKS = 8
_SIGNIFICANT = 0.01


@dataclass(frozen=True, slots=True)
class Difference:
    """One quantity of two runs.

    Attributes
    ----------
    name, unit : str
    ours, theirs : float
    p_value : float
        Chance of a difference as large between runs that are alike; NaN where there is no test.
    """

    name: str
    unit: str
    ours: float
    theirs: float
    p_value: float = math.nan

    @property
    def said(self) -> str:
        """The verdict in words."""
        if math.isnan(self.p_value):
            return ""
        if self.p_value >= _SIGNIFICANT:
            return "no significant difference"
        return "larger" if self.ours > self.theirs else "smaller"


def compare(ours: Analysis, theirs: Analysis) -> list[Difference]:
    """Differences of two analyses.

    Means and spreads are tested between blocks: each run gives a mean and a log variance every five minutes, and
    Welch's t test asks whether the two sets differ. Slopes are tested by their own standard errors.
    """
    found: list[Difference] = []
    for name, a, b in (("reading", ours.reading, theirs.reading), ("true centre", ours.true, theirs.true)):
        if a is not None and b is not None:
            found += _series(name, a, b)
    if ours.benefit is not None and theirs.benefit is not None:
        found.append(
            Difference("without feed-forward", "µm", ours.benefit.without_um, theirs.benefit.without_um)
        )  # fmt: skip
    found.append(Difference("leak", "µm/s", ours.leak_um_per_s[0], theirs.leak_um_per_s[0]))
    mine, other = ours.ticks, theirs.ticks
    found += [
        Difference("pump, mean", "of full", mine.pump.mean_fraction, other.pump.mean_fraction),
        Difference("pump strokes", "1/h", mine.pump.travel_per_hour, other.pump.travel_per_hour),
        Difference("lateness p99", "ms", mine.lateness_ms.quantile(0.99), other.lateness_ms.quantile(0.99)),
    ]
    if ours.shape is not None and theirs.shape is not None:
        found.append(Difference("figure, mean SD", "µm", ours.shape.mean_sd_um, theirs.shape.mean_sd_um))
        parting = ours.shape.disagreement, theirs.shape.disagreement
        mine_per_hour, other_per_hour = (slope.per_hour for slope in parting)
        found.append(Difference("sag − laser", "µm/h", mine_per_hour, other_per_hour, _slope_p(*parting)))
    return found


def _series(name: str, a: Series, b: Series) -> list[Difference]:
    seconds = a.windows[0], b.windows[0]
    means, spreads = zip(*(_blocks(series.seconds_um) for series in (a, b)), strict=True)
    slope_p = _slope_p(a.drift, b.drift)
    found = [
        Difference(f"{name}, mean", "µm", seconds[0].mean_um, seconds[1].mean_um, _welch(*means)),
        Difference(f"{name}, std of 1 s", "µm", seconds[0].std_um, seconds[1].std_um, _welch(*spreads)),
        Difference(f"{name}, drift", "µm/h", a.drift.per_hour, b.drift.per_hour, slope_p),
    ]
    for x, y in zip(a.windows[1:], b.windows[1:], strict=True):
        found.append(Difference(f"{name}, std of {x.window_s:g} s", "µm", x.std_um, y.std_um))
    return found


def _blocks(seconds_um: Column) -> tuple[Column, Column]:
    """Mean and log variance of each block of 1 s means."""
    time_s, values = seconds_um
    if values.size < 2 * _LEAST_BLOCKS:
        return np.empty(0), np.empty(0)
    block_s = min(_BLOCK_S, float(np.ptp(time_s)) / _LEAST_BLOCKS)
    number = np.floor((time_s - time_s[0]) / block_s).astype(np.int64)
    number = np.minimum(number, max(0, int(np.ptp(time_s) / block_s) - 1))
    count = np.bincount(number)
    whole = count >= 0.5 * np.median(count[count > 0])
    mean = np.bincount(number, values) / np.maximum(count, 1)
    variance = np.bincount(number, (values - mean[number]) ** 2) / np.maximum(count - 1, 1)
    kept = whole & (variance > 0)
    return mean[kept], np.log(variance[kept])


def _welch(a: Column, b: Column) -> float:
    if min(a.size, b.size) < 3:
        return math.nan
    return float(stats.ttest_ind(a, b, equal_var=False).pvalue)


def _slope_p(a: Slope, b: Slope) -> float:
    sigmas = [(slope.high - slope.low) / 2 / 1.96 for slope in (a, b)]
    if not all(math.isfinite(sigma) and sigma > 0 for sigma in sigmas):
        return math.nan
    return float(2 * stats.norm.sf(abs(a.per_hour - b.per_hour) / math.hypot(*sigmas)))
