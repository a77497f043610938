"""Statistics of the error while the mirror was held: windows, spectra, Allan deviation, drift."""

from dataclasses import dataclass

import numpy as np
from scipy import fft

from membrane_ctrl.model.arrays import Column, Singles
from membrane_ctrl.review.statistics import allan_deviation, power_spectrum
from membrane_ctrl.review.statistics.drift import FittedSlope, fit_slope
from membrane_ctrl.review.statistics.hold_pass import (
    ERROR,
    READING,
    HoldPass,
)
from membrane_ctrl.review.statistics.window_means import (
    WindowStatistics,
    describe_windows,
    window_means,
)
from membrane_ctrl.run_files.run import Run

WINDOWS_S = (1, 4, 60)
# The slope is fitted to minutes or, in a short run, to seconds.
_SLOPE_MINUTES_FROM_S = 3600.0
# A straight line bridges a missed tick or a glitch; otherwise no segment of a spectrum would be
# complete.
FILLED_S = 0.5
# Of the 1 s means, whose spectrum is used below 0.1 Hz: gaps left by a laser without light for a
# moment.
_FILLED_SECONDS = 5
# A day has slower and larger motions than any hold; longer means add nothing to the slope.
_ALLAN_LONGEST_S = 1e5


@dataclass(frozen=True, slots=True)
class ErrorSeries:
    """Statistics of one error: `reading` (in the loop) or `true` (the twin's centre)."""

    windows: tuple[WindowStatistics, ...]  # at `WINDOWS_S`
    seconds_um: Column  # (2, n): times and means of the 1 s windows
    allan: allan_deviation.Allan
    spectrum: power_spectrum.Spectrum  # of the ticks
    # Of the 1 s means, in segments of half the hold: for motion slower than the segments of
    # `spectrum`
    slow: power_spectrum.Spectrum
    drift: FittedSlope  # µm per hour


def describe_error(run: Run, ticks: HoldPass, which: int) -> ErrorSeries | None:
    """Return the statistics of one error over the settled hold.

    Parameters
    ----------
    run : Run
    ticks : HoldPass
        One pass over the hold.
    which : int
        `READING` (the error in the loop) or `TRUE` (that of the twin's centre).

    Returns
    -------
    ErrorSeries or None
        None if no tick has such an error.
    """
    rate_hz = run.config.loop.rate_hz
    band_um = run.config.limits.band_um
    second, counts, sums = ticks.seconds[which]
    moments = ticks.raw_reading if which == READING else ticks.raw_true
    if not moments.count:
        return None
    # Means over windows, for their statistics and the drift
    means = {w: window_means(second, counts, sums[ERROR], w, rate_hz) for w in WINDOWS_S}
    # All ticks on an even grid from the first value to the last, for the spectrum; short gaps are
    # bridged
    grid = ticks.reading_um if which == READING else ticks.true_um
    grid = fill_short_gaps(
        grid[_places_before_first(grid) : grid.size - _places_before_first(grid[::-1])],
        round(FILLED_S * rate_hz),
    )
    # Lengths of the Allan deviation: powers of two, up to a quarter of the hold
    longest = max(1, min(grid.size // 4, round(_ALLAN_LONGEST_S * rate_hz)))
    lengths = 2 ** np.arange(int(np.log2(longest)) + 1)
    minutes = ticks.hold_s >= _SLOPE_MINUTES_FROM_S
    return ErrorSeries(
        windows=tuple(describe_windows(means[w][1], w, band_um) for w in WINDOWS_S),
        seconds_um=np.stack(means[1]),
        allan=allan_deviation.allan_deviation(grid, 1 / rate_hz, lengths),
        spectrum=power_spectrum.power_spectrum(grid, rate_hz),
        slow=slow_spectrum(*means[1]),
        drift=fit_slope(*means[60 if minutes else 1]),
    )


def slow_spectrum(time_s: Column, means: Column) -> power_spectrum.Spectrum:
    """Return the spectrum of 1 s means in segments half as long as the longest gapless stretch:
    three in a whole hold. Gaps up to 5 s are bridged.

    Parameters
    ----------
    time_s : (n,) array
        Middles of the seconds.
    means : (n,) array
        Their means, in any unit.
    """
    if not time_s.size:
        return power_spectrum.power_spectrum(np.empty(0), 1.0)

    # The means on a grid of whole seconds, short gaps filled.
    place = np.floor(time_s - time_s[0] + 0.5).astype(np.int64)
    grid = np.full(int(place[-1]) + 1, np.nan, dtype=np.float32)
    grid[place] = means
    grid = fill_short_gaps(grid, _FILLED_SECONDS)

    # The longest stretch between two gaps; the ends count as gaps.
    gaps = np.flatnonzero(~np.isfinite(np.concatenate(([np.nan], grid, [np.nan]))))
    longest = int(np.diff(gaps).max()) - 1
    segment = fft.prev_fast_len(max(8, longest // 2), real=True)
    return power_spectrum.power_spectrum(grid, 1.0, segment)


def fill_short_gaps(values: Singles, most: int) -> Singles:
    """Fill short gaps with straight lines; longer ones and those at the ends stay NaN.

    Parameters
    ----------
    values : (n,) array
        The series; NaN in gaps.
    most : int
        Longest gap to fill, in values.

    Returns
    -------
    (n,) array
        A copy.
    """
    gap = ~np.isfinite(values)
    # Where gaps begin and end, in turn
    padded = np.concatenate(([False], gap, [False])).astype(np.int8)
    edges = np.flatnonzero(np.diff(padded))
    filled = values.copy()
    for start, end in edges.reshape(-1, 2):
        length = end - start
        is_inside = start > 0 and end < values.size
        if length <= most and is_inside:
            line = np.linspace(values[start - 1], values[end], length + 2)
            filled[start:end] = line[1:-1]
    return filled


def _places_before_first(grid: Singles) -> int:
    """Places before the first value."""
    return int(np.argmax(np.isfinite(grid)))
