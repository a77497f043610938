"""Finds doors: steps of the air pressure within a few seconds."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import Column, IntArray
from membrane_ctrl.review.events.steps import FoundStep, local_sigma

# A door takes up to 5 s, and a start within a second adds a window; longer changes are weather.
LAGS = (1, 2, 3, 4, 6, 8)
# Nine in ten differences are weather: a coarse barometer repeats its value in more than half of the
# windows.
_USUAL_SHARE = 0.9
# Standard deviation of the difference of two rounded values, in rounding steps.
_ROUNDING = 6**-0.5
# A slower barometer cannot detect doors.
_SLOWEST_S = 120
# A value every third second changes two seconds of three if it comes within one; more is not a
# period.
_ALWAYS_NEW = 0.85
# Of the times between new values: an interval that is short by chance is not the period.
_LOW_SHARE = 0.02
# The best window stands out most from the weather; the step may extend a second beyond it.
_BEYOND = 1


@dataclass(frozen=True, slots=True)
class _Candidates:
    """Windows with a sufficient difference: first row, length, difference and its sigmas."""

    row: IntArray
    lag: IntArray
    size: Column
    score: Column


def find_door_steps(
    mean_pa: Column, reading_pa: Column, least_pa: float, least_sigmas: float
) -> list[FoundStep]:
    """Steps of the air pressure, each once; both of a door that is closed at once.

    Parameters
    ----------
    mean_pa : (n,) array
        One-second means, NaN where missing.
    reading_pa : (n,) array
        One reading per second, which shows the barometer's resolution.
    least_pa : float
        Smallest step.
    least_sigmas : float
        Smallest step relative to nearby differences of equally long windows.

    Returns
    -------
    list of FoundStep
        In order of time, each at its steepest second.
    """
    # A slow barometer repeats each value: one row per new value.
    every = update_s(mean_pa)
    floor_pa = _ROUNDING * reading_resolution_pa(reading_pa)
    values = mean_pa[::every]

    # Windows that differ from the weather, the strongest ones first. At least two values long: a
    # step may fall on the one between.
    lags = tuple(lag for lag in LAGS if lag <= 2 or lag * every <= LAGS[-1])
    found = _find_candidates(values, lags, floor_pa, least_pa, least_sigmas)
    chosen = _choose_strongest(found, values.size)

    result = []
    for place in sorted(chosen, key=lambda place: int(found.row[place])):
        row = int(found.row[place])
        lag = int(found.lag[place])
        size = float(found.size[place])
        if every == 1:
            size = _whole_size(values, row, lag, size)
        first = row * every
        last = (row + lag) * every
        changes = np.abs(np.diff(mean_pa[first : last + 1]))
        steepest = first + 1 + int(np.argmax(np.nan_to_num(changes)))
        result.append(FoundStep(steepest, size, float(found.score[place])))
    return result


def update_s(mean_pa: Column) -> int:
    """Seconds for which the barometer repeats a value, from its 1 s means (n,); 1 if most seconds
    have a new one.
    """
    changes = np.nan_to_num(np.diff(mean_pa))
    new = np.concatenate(([False], changes != 0))
    if np.count_nonzero(new) > _ALWAYS_NEW * np.count_nonzero(np.isfinite(mean_pa)):
        return 1
    # A new value within a second changes two means: the first one counts.
    new_before = np.concatenate(([False], new[:-1]))
    begins = np.flatnonzero(new & ~new_before)
    if begins.size < 2:
        return 1
    between_s = int(np.quantile(np.diff(begins), _LOW_SHARE, method="lower"))
    # two seconds also result from a coarse barometer that alternates between two values
    if 2 < between_s <= _SLOWEST_S:
        return between_s
    return 1


def reading_resolution_pa(reading_pa: Column) -> float:
    """The resolution of readings (n,), Pa: about the smallest change; almost 0 for a fine
    barometer.
    """
    change = np.abs(np.diff(reading_pa))
    change = change[np.isfinite(change) & (change > 0)]
    if not change.size:
        return 0.0
    return float(np.quantile(change, _LOW_SHARE))


def _find_candidates(
    values: Column, lags: tuple[int, ...], floor_pa: float, least_pa: float, least_sigmas: float
) -> _Candidates:
    """Windows whose ends differ by at least `least_pa`, and by `least_sigmas` of the weather's
    differences nearby.
    """
    parts = []
    for lag in lags:  # one after the other: each takes 20 MB for a month
        # A change over the lag, against the usual changes over it nearby.
        change = values[lag:] - values[:-lag]
        size = np.abs(change)
        sigma = np.fmax(local_sigma(change, _USUAL_SHARE), max(floor_pa, 1e-9))
        rows = np.flatnonzero((size >= least_pa) & (size >= least_sigmas * sigma))
        scores = size[rows] / sigma[rows]
        parts.append(_Candidates(rows, np.full(rows.size, lag), change[rows], scores))
    return _Candidates(
        np.concatenate([part.row for part in parts]),
        np.concatenate([part.lag for part in parts]),
        np.concatenate([part.size for part in parts]),
        np.concatenate([part.score for part in parts]),
    )


def _choose_strongest(found: _Candidates, rows: int) -> list[int]:
    """The windows that stand out most; others nearby with the same sign belong to the same step."""
    reach = LAGS[-1]
    # Rows near a chosen window, of falling and of rising steps.
    covered = {False: np.zeros(rows, dtype=bool), True: np.zeros(rows, dtype=bool)}
    chosen = []
    for place in np.argsort(-found.score, kind="stable"):
        row = int(found.row[place])
        end = row + int(found.lag[place])
        rises = bool(found.size[place] > 0)
        if covered[rises][row:end].any():
            continue
        covered[rises][max(0, row - reach) : end + reach] = True
        chosen.append(int(place))
    return chosen


def _whole_size(values: Column, row: int, lag: int, size: float) -> float:
    """The largest change of slightly wider windows that contain this one."""
    sign = np.sign(size)
    before = sign * values[max(0, row - _BEYOND) : row + 1]
    after = sign * values[row + lag : row + lag + _BEYOND + 1]
    return float(sign * (np.nanmax(after) - np.nanmin(before)))
