"""Finds laser readings that jump and jump back.

Spikes last less than a second, glitches up to a minute.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from membrane_ctrl.model.arrays import BoolArray, Column
from membrane_ctrl.review.events.steps import local_sigma, mean_differences

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
_LEAST_RATIO = 0.5
_EDGE_S = 2


@dataclass(frozen=True, slots=True)
class Glitch:
    """A reading that was not the mirror's: first and last row, µm, and sigmas above the noise."""

    first: int
    last: int
    size_um: float
    sigmas: float


def find_glitches(
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

    Returns
    -------
    list of Glitch
        In order of time.
    """
    if not np.isfinite(mean_um).any():
        return []
    size_um = _largest_deviation(low_um, mean_um, high_um)
    edges = _find_edges(mean_um, usable & calm)
    long_glitches = [_measure_size(glitch, size_um) for glitch in _pair_edges(edges)]
    # Spikes are searched away from the longer glitches.
    remaining = usable.copy()
    for glitch in long_glitches:
        first = max(0, glitch.first - _EDGE_S)
        remaining[first : glitch.last + _EDGE_S + 1] = False
    spikes = _find_spikes(size_um, mean_um, remaining)
    return sorted(long_glitches + spikes, key=lambda glitch: glitch.first)


def _largest_deviation(low_um: Column, mean_um: Column, high_um: Column) -> Column:
    """(n,) per second, the largest deviation of a reading from the surrounding seconds."""
    rows = np.arange(mean_um.size)
    is_finite = np.isfinite(mean_um)
    without_gaps = np.interp(rows, rows[is_finite], mean_um[is_finite])
    base = ndimage.median_filter(without_gaps, _BASE_S, mode="nearest")
    above = high_um - base
    below = base - low_um
    return np.where(above >= below, above, -below)


def _measure_size(glitch: Glitch, size_um: Column) -> Glitch:
    """Take the size of a short glitch from its readings: the mean of a second dilutes it."""
    if glitch.last - glitch.first > _BASE_S // 2:
        return glitch
    part = size_um[glitch.first - 1 : glitch.last + 2]
    largest = np.nanargmax(np.abs(part))
    return replace(glitch, size_um=float(part[largest]))


def _find_spikes(size_um: Column, mean_um: Column, usable: BoolArray) -> list[Glitch]:
    """A reading far from the surrounding seconds, with the mirror unmoved before and after."""
    far = np.abs(size_um)
    excess = far - float(np.nanmedian(far))
    sigma = local_sigma(excess)
    moved = np.nan_to_num(np.abs(mean_differences(mean_um, 1, 1)))
    threshold = np.fmax(GLITCH_LEAST_UM, GLITCH_LEAST_SIGMAS * sigma)
    found = np.flatnonzero((excess > threshold) & (moved < _MOVED_MOST * far) & usable)
    # Neighbouring seconds show the same spike.
    if found.size:
        is_first = np.concatenate(([True], np.diff(found) > 2))
        found = found[is_first]
    score = excess / np.maximum(sigma, 1e-9)
    return [Glitch(int(row), int(row), float(size_um[row]), float(score[row])) for row in found]


def _find_edges(mean_um: Column, usable: BoolArray) -> list[Glitch]:
    """Steps of the reading within two seconds, each a glitch without an end; `first` is the second
    of the step.
    """
    change = np.full(mean_um.size, np.nan)
    change[1:-1] = mean_um[_EDGE_S:] - mean_um[:-_EDGE_S]
    sigma = local_sigma(change)
    size = np.nan_to_num(np.abs(change))
    threshold = np.fmax(GLITCH_LEAST_UM, GLITCH_LEAST_SIGMAS * sigma)
    rows = np.flatnonzero((size >= threshold) & usable)
    if not rows.size:
        return []
    # Neighbouring rows of one sign are one edge, at the row of the largest change.
    begins_edge = (np.diff(rows) > 1) | (np.diff(np.sign(change[rows])) != 0)
    found = []
    for part in np.split(rows, np.flatnonzero(begins_edge) + 1):
        row = int(part[np.argmax(size[part])])
        score = float(size[row] / max(sigma[row], 1e-9))
        # The one of the two seconds that changed more.
        before = abs(mean_um[row] - mean_um[row - 1])
        after = abs(mean_um[row + 1] - mean_um[row])
        second = row + 1 if after > before else row
        found.append(Glitch(second, second, float(change[row]), score))
    return found


def _pair_edges(edges: list[Glitch]) -> list[Glitch]:
    """Pairs of opposite edges; unpaired edges are not glitches."""
    found: list[Glitch] = []
    for place, edge in enumerate(edges):
        if found and edge.first <= found[-1].last:
            continue
        later = edges[place + 1 : place + 1 + GLITCH_LONGEST_S]
        back = _find_return_edge(edge, later)
        if back is not None:
            found.append(Glitch(edge.first, back.first, edge.size_um, edge.sigmas))
    return found


def _find_return_edge(edge: Glitch, later: list[Glitch]) -> Glitch | None:
    """The largest opposite edge before the next equal one: a loop at full speed makes smaller
    ones.
    """
    best = None
    for other in later:
        is_too_late = other.first > edge.first + GLITCH_LONGEST_S
        if is_too_late or _are_similar(edge.size_um, other.size_um):
            break
        if not _are_similar(edge.size_um, -other.size_um):
            continue
        if best is None or abs(other.size_um) > abs(best.size_um):
            best = other
    return best


def _are_similar(size_um: float, other_um: float) -> bool:
    """Whether two changes have the same sign and about the same size."""
    if size_um * other_um <= 0:
        return False
    ratio = abs(size_um / other_um)
    return _LEAST_RATIO <= ratio <= 1 / _LEAST_RATIO
