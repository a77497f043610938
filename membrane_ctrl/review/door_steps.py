"""Steps of the air pressure: quick or slow ones, seen by quick, slow or coarse barometers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.review.steps import Column, Step, local_sigma

# A door takes up to 5 s, and what begins within a second takes a window more; longer changes are weather.
_LAGS = (1, 2, 3, 4, 6, 8)
# Nine in ten differences are weather: a coarse barometer repeats its value in more than half of the windows.
_USUAL_SHARE = 0.9
# The difference of two rounded values has this standard deviation, in steps of the rounding.
_ROUNDING = 6**-0.5
# A barometer that is slower than this tells of no door.
_SLOWEST_S = 120
# A value every third second changes two seconds of three, if it comes in the middle of one; more is no period.
_ALWAYS_NEW = 0.85
# Of the times between new values: one that is shorter by chance is no period.
_LOW_SHARE = 0.02
# The best window is the one that stands out most from the weather; the step may go a second beyond it.
_BEYOND = 1


@dataclass(frozen=True, slots=True)
class _Candidates:
    """Windows that differ enough: first row, length, difference and its sigmas."""

    row: NDArray[np.intp]
    lag: NDArray[np.intp]
    size: Column
    score: Column


def door_steps(mean_pa: Column, reading_pa: Column, least_pa: float, least_sigmas: float) -> list[Step]:
    """Steps of the air pressure, one for each that happened; of a door that is closed at once, both.

    Parameters
    ----------
    mean_pa : (n,) array
        Means of a second each, NaN where there is none.
    reading_pa : (n,) array
        A single reading of each second, that shows in which steps the barometer counts.
    least_pa : float
    least_sigmas : float
        Against the differences nearby of windows as long.
    """
    every = update_s(mean_pa)
    floor_pa = _ROUNDING * quantum(reading_pa)
    values = mean_pa[::every]
    found = _candidates(values, _lags(every), floor_pa, least_pa, least_sigmas)
    chosen = sorted(_chosen(found, values.size), key=lambda place: int(found.row[place]))
    result = []
    for place in chosen:
        row, lag = int(found.row[place]), int(found.lag[place])
        size = _whole_size(values, row, lag, float(found.size[place])) if every == 1 else float(found.size[place])
        result.append(Step(_steepest(mean_pa, row * every, (row + lag) * every), size, float(found.score[place])))
    return result


def looked_at(rows: int) -> int:
    """Windows that `door_steps` looks at in so many rows."""
    return rows * len(_LAGS)


def update_s(mean_pa: Column) -> int:
    """Seconds for which the barometer repeats a value; 1 when most seconds have their own."""
    new = np.concatenate(([False], np.nan_to_num(np.diff(mean_pa)) != 0))
    if np.count_nonzero(new) > _ALWAYS_NEW * np.count_nonzero(np.isfinite(mean_pa)):
        return 1
    # a value that comes within a second changes the mean of two
    begins = np.flatnonzero(new & ~np.concatenate(([False], new[:-1])))
    if begins.size < 2:
        return 1
    between_s = int(np.quantile(np.diff(begins), _LOW_SHARE, method="lower"))
    # two seconds are those of a coarse barometer, too, that goes to and fro between two values
    return between_s if 2 < between_s <= _SLOWEST_S else 1


def quantum(reading_pa: Column) -> float:
    """The step in which readings count, Pa: about the least change there is; next to 0 of a fine barometer."""
    change = np.abs(np.diff(reading_pa))
    change = change[np.isfinite(change) & (change > 0)]
    return float(np.quantile(change, _LOW_SHARE)) if change.size else 0.0


def _lags(every: int) -> tuple[int, ...]:
    # two values at least: a step may fall on the one between
    return tuple(lag for lag in _LAGS if lag <= 2 or lag * every <= _LAGS[-1])


def _candidates(
    values: Column, lags: tuple[int, ...], floor_pa: float, least_pa: float, least_sigmas: float
) -> _Candidates:
    parts = []
    for lag in lags:  # one after the other: of a month each is 20 MB
        change = values[lag:] - values[:-lag]
        sigma = np.fmax(local_sigma(change, _USUAL_SHARE), max(floor_pa, 1e-9))
        rows = np.flatnonzero((np.abs(change) >= least_pa) & (np.abs(change) >= least_sigmas * sigma))
        parts.append((rows, np.full(rows.size, lag), change[rows], np.abs(change[rows]) / sigma[rows]))
    row, lag_of, size, score = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return _Candidates(row, lag_of, size, score)


def _chosen(found: _Candidates, rows: int) -> list[int]:
    """The windows that stand out most; others nearby with the same sign are of the same step."""
    reach = _LAGS[-1]
    taken = np.zeros((2, rows), dtype=bool)
    chosen = []
    for place in np.argsort(-found.score, kind="stable"):
        row, end = int(found.row[place]), int(found.row[place] + found.lag[place])
        same = taken[int(found.size[place] > 0)]
        if not same[row:end].any():
            same[max(0, row - reach) : end + reach] = True
            chosen.append(int(place))
    return chosen


def _whole_size(values: Column, row: int, lag: int, size: float) -> float:
    """The greatest change of windows that hold this one and reach a little beyond it."""
    sign = np.sign(size)
    before = sign * values[max(0, row - _BEYOND) : row + 1]
    after = sign * values[row + lag : row + lag + _BEYOND + 1]
    return float(sign * (np.nanmax(after) - np.nanmin(before)))


def _steepest(mean_pa: Column, first: int, last: int) -> int:
    """Row with the greatest change from the one before it, of those behind `first` and up to `last`."""
    return first + 1 + int(np.argmax(np.nan_to_num(np.abs(np.diff(mean_pa[first : last + 1])))))
