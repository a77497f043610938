"""Means of a series over windows of seconds, and their statistics."""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import Column
from membrane_ctrl.review.statistics.second_sums import Counts, Seconds, group_starts
from membrane_ctrl.run_files.run_statistics import count_least_ticks


@dataclass(frozen=True, slots=True)
class WindowStatistics:
    """Statistics of means over windows of one length; NaN without windows; a single window has no
    `std_um`.
    """

    window_s: float  # 0: single ticks
    count: int
    mean_um: float
    std_um: float
    max_um: float
    p99_7_um: float
    in_band: float  # share within the band


def window_means(
    second: Seconds, counts: Counts, sums: Column, window_s: int, rate_hz: float
) -> tuple[Column, Column]:
    """Middles and means of the windows that have at least `count_least_ticks` ticks.

    Parameters
    ----------
    second : (n,) int array
        Number of each second of the run.
    counts : (n,) int array
        Its ticks.
    sums : (n,) array
        Sum of the signal over them, as `SecondSums` has it.
    window_s : int
        Length of a window.
    rate_hz : float
        Ticks a second.

    Returns
    -------
    middles_s, means : (k,) arrays
    """
    if not second.size:
        return np.empty(0), np.empty(0)
    # Sums over the seconds of each window; windows with too few ticks or a gap do not count.
    number = second // window_s
    starts = group_starts(number)
    ticks = np.add.reduceat(counts, starts)
    total = np.add.reduceat(sums, starts)
    whole = (ticks >= count_least_ticks(window_s, rate_hz)) & np.isfinite(total)
    middles_s = np.asarray((number[starts][whole] + 0.5) * window_s, dtype=np.float64)
    return middles_s, total[whole] / ticks[whole]


def describe_windows(means_um: Column, window_s: float, band_um: float) -> WindowStatistics:
    """Statistics of the means of windows.

    Parameters
    ----------
    means_um : (k,) array
        Mean control error of each window, µm.
    window_s : float
        Length of a window.
    band_um : float
        Half width of the band in which the mirror counts as held, µm.
    """
    if not means_um.size:
        return WindowStatistics(window_s, 0, math.nan, math.nan, math.nan, math.nan, math.nan)
    size_um = np.abs(means_um)
    return WindowStatistics(
        window_s,
        int(means_um.size),
        float(means_um.mean()),
        float(means_um.std()) if means_um.size > 1 else math.nan,
        float(size_um.max()),
        float(np.quantile(size_um, 0.997)),
        float((size_um <= band_um).mean()),
    )
