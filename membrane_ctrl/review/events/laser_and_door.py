"""Laser readings that jump and jump back (spikes within a second, glitches of up to a minute), and
doors.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from membrane_ctrl.model.arrays import BoolArray, Column, IntArray
from membrane_ctrl.review.events.steps import FoundStep, differences, local_sigma

# A laser's noise is 1 µm; the film cannot make a spike of a single tick.
GLITCH_LEAST_UM = 4.0
GLITCH_LEAST_SIGMAS = 8.0
# Longer ones the loop follows and the camera contradicts.
GLITCH_LONGEST_S = 60
# Longer than spikes, shorter than effects of weather and loop.
_BASE_S = 7
# A glitch within a second leaves the mirror where it was.
_MOVED_MOST = 0.3
# Both edges have the same size, except for the loop's action within two seconds: up to 4 µm/s.
_EDGES_ALIKE = 0.5
_EDGE_S = 2


@dataclass(frozen=True, slots=True)
class Glitch:
    """A reading that was not the mirror's: first and last row, µm, and sigmas above the noise."""

    first: int
    last: int
    size_um: float
    sigmas: float


def glitches(
    low_um: Column, mean_um: Column, high_um: Column, usable: BoolArray, calm: BoolArray
) -> list[Glitch]:
    """Spikes and longer glitches, each once.

    Parameters
    ----------
    low_um, mean_um, high_um : (n,) arrays
        Minimum, mean and maximum reading of each second.
    usable : (n,) array
        Seconds in which the mirror is held, and neither a step of the air pressure moved it nor the
        laser was lost.
    calm : (n,) array
        Seconds that a barometer confirms as calm: without one, a door closed again looks like a
        long glitch.
    """
    if not np.isfinite(mean_um).any():
        return []
    size_um = _farthest(low_um, mean_um, high_um)
    long = [_sized(glitch, size_um) for glitch in _pairs(_edges(mean_um, usable & calm))]
    apart = usable.copy()
    for glitch in long:
        apart[max(0, glitch.first - _EDGE_S) : glitch.last + _EDGE_S + 1] = False
    return sorted(long + _spikes(size_um, mean_um, apart), key=lambda glitch: glitch.first)


def _farthest(low_um: Column, mean_um: Column, high_um: Column) -> Column:
    """(n,) per second, the largest deviation of a reading from the surrounding seconds."""
    rows = np.arange(mean_um.size)
    there = np.isfinite(mean_um)
    base = ndimage.median_filter(
        np.interp(rows, rows[there], mean_um[there]), _BASE_S, mode="nearest"
    )
    above, below = high_um - base, base - low_um
    return np.where(above >= below, above, -below)


def _sized(glitch: Glitch, size_um: Column) -> Glitch:
    """Take the size of a short glitch from its readings: the mean of a second dilutes it."""
    if glitch.last - glitch.first > _BASE_S // 2:
        return glitch
    part = size_um[glitch.first - 1 : glitch.last + 2]
    return replace(glitch, size_um=float(part[np.nanargmax(np.abs(part))]))


def _spikes(size_um: Column, mean_um: Column, usable: BoolArray) -> list[Glitch]:
    """A reading far from the surrounding seconds, with the mirror unmoved before and after."""
    far = np.abs(size_um)
    usual = float(np.nanmedian(far))
    sigma = local_sigma(far - usual)
    moved = np.nan_to_num(np.abs(differences(mean_um, 1, 1)))
    enough = np.fmax(GLITCH_LEAST_UM, GLITCH_LEAST_SIGMAS * sigma)
    found = np.flatnonzero((far - usual > enough) & (moved < _MOVED_MOST * far) & usable)
    found = found[np.concatenate(([True], np.diff(found) > 2))] if found.size else found
    score = (far - usual) / np.maximum(sigma, 1e-9)
    return [Glitch(int(row), int(row), float(size_um[row]), float(score[row])) for row in found]


def _edges(mean_um: Column, usable: BoolArray) -> list[Glitch]:
    """Steps of the reading within two seconds, each a glitch without an end; `first` is the second
    of the step.
    """
    change = np.full(mean_um.size, np.nan)
    change[1:-1] = mean_um[_EDGE_S:] - mean_um[:-_EDGE_S]
    sigma = local_sigma(change)
    size = np.nan_to_num(np.abs(change))
    rows = np.flatnonzero((size >= np.fmax(GLITCH_LEAST_UM, GLITCH_LEAST_SIGMAS * sigma)) & usable)
    if not rows.size:
        return []
    other = (np.diff(rows) > 1) | (np.diff(np.sign(change[rows])) != 0)
    best = [int(part[np.argmax(size[part])]) for part in np.split(rows, np.flatnonzero(other) + 1)]
    found = []
    for row in best:
        score = float(size[row] / max(sigma[row], 1e-9))
        # the one of the two seconds that changed more
        at = row + int(abs(mean_um[row + 1] - mean_um[row]) > abs(mean_um[row] - mean_um[row - 1]))
        found.append(Glitch(at, at, float(change[row]), score))
    return found


def _pairs(edges: list[Glitch]) -> list[Glitch]:
    """Pairs of opposite edges; unpaired edges are not glitches."""
    found: list[Glitch] = []
    for place, edge in enumerate(edges):
        if found and edge.first <= found[-1].last:
            continue
        back = _back(edge, edges[place + 1 : place + 1 + GLITCH_LONGEST_S])
        if back is not None:
            found.append(Glitch(edge.first, back.first, edge.size_um, edge.sigmas))
    return found


def _back(edge: Glitch, later: list[Glitch]) -> Glitch | None:
    """The largest opposite edge before the next equal one:
    a loop at full speed makes smaller ones.
    """
    best = None
    for other in later:
        if other.first > edge.first + GLITCH_LONGEST_S or _alike(edge.size_um, other.size_um):
            break
        if _alike(edge.size_um, -other.size_um) and (
            best is None or abs(other.size_um) > abs(best.size_um)
        ):
            best = other
    return best


def _alike(size_um: float, other_um: float) -> bool:
    return size_um * other_um > 0 and _EDGES_ALIKE <= abs(size_um / other_um) <= 1 / _EDGES_ALIKE


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


def door_steps(
    mean_pa: Column, reading_pa: Column, least_pa: float, least_sigmas: float
) -> list[FoundStep]:
    """Steps of the air pressure, each once; both of a door that is closed at once.

    Parameters
    ----------
    mean_pa : (n,) array
        One-second means, NaN where missing.
    reading_pa : (n,) array
        One reading per second, which shows the barometer's resolution.
    least_sigmas : float
        Relative to nearby differences of equally long windows.
    """
    every = update_s(mean_pa)
    floor_pa = _ROUNDING * quantum(reading_pa)
    values = mean_pa[::every]
    # at least two values: a step may fall on the one between
    lags = tuple(lag for lag in LAGS if lag <= 2 or lag * every <= LAGS[-1])
    found = _candidates(values, lags, floor_pa, least_pa, least_sigmas)
    chosen = sorted(_chosen(found, values.size), key=lambda place: int(found.row[place]))
    result = []
    for place in chosen:
        row, lag = int(found.row[place]), int(found.lag[place])
        size = (
            _whole_size(values, row, lag, float(found.size[place]))
            if every == 1
            else float(found.size[place])
        )
        changes = np.abs(np.diff(mean_pa[row * every : (row + lag) * every + 1]))
        steepest = row * every + 1 + int(np.argmax(np.nan_to_num(changes)))
        result.append(FoundStep(steepest, size, float(found.score[place])))
    return result


def update_s(mean_pa: Column) -> int:
    """Seconds for which the barometer repeats a value; 1 if most seconds have a new one."""
    new = np.concatenate(([False], np.nan_to_num(np.diff(mean_pa)) != 0))
    if np.count_nonzero(new) > _ALWAYS_NEW * np.count_nonzero(np.isfinite(mean_pa)):
        return 1
    # a new value within a second changes two means
    begins = np.flatnonzero(new & ~np.concatenate(([False], new[:-1])))
    if begins.size < 2:
        return 1
    between_s = int(np.quantile(np.diff(begins), _LOW_SHARE, method="lower"))
    # two seconds also result from a coarse barometer that alternates between two values
    return between_s if 2 < between_s <= _SLOWEST_S else 1


def quantum(reading_pa: Column) -> float:
    """The resolution of the readings, Pa: about the smallest change;
    almost 0 for a fine barometer.
    """
    change = np.abs(np.diff(reading_pa))
    change = change[np.isfinite(change) & (change > 0)]
    return float(np.quantile(change, _LOW_SHARE)) if change.size else 0.0


def _candidates(
    values: Column, lags: tuple[int, ...], floor_pa: float, least_pa: float, least_sigmas: float
) -> _Candidates:
    parts = []
    for lag in lags:  # one after the other: each takes 20 MB for a month
        change = values[lag:] - values[:-lag]
        sigma = np.fmax(local_sigma(change, _USUAL_SHARE), max(floor_pa, 1e-9))
        rows = np.flatnonzero(
            (np.abs(change) >= least_pa) & (np.abs(change) >= least_sigmas * sigma)
        )
        parts.append(
            (rows, np.full(rows.size, lag), change[rows], np.abs(change[rows]) / sigma[rows])
        )
    row, lag_of, size, score = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return _Candidates(row, lag_of, size, score)


def _chosen(found: _Candidates, rows: int) -> list[int]:
    """The windows that stand out most; others nearby with the same sign belong to the same step."""
    reach = LAGS[-1]
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
    """The largest change of slightly wider windows that contain this one."""
    sign = np.sign(size)
    before = sign * values[max(0, row - _BEYOND) : row + 1]
    after = sign * values[row + lag : row + lag + _BEYOND + 1]
    return float(sign * (np.nanmax(after) - np.nanmin(before)))
