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
_EDGES_ALIKE = 0.5
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
    """
    if not np.isfinite(mean_um).any():
        return []
    size_um = _largest_deviation(low_um, mean_um, high_um)
    long = [
        _measure_size(glitch, size_um)
        for glitch in _pair_edges(_find_edges(mean_um, usable & calm))
    ]
    apart = usable.copy()
    for glitch in long:
        apart[max(0, glitch.first - _EDGE_S) : glitch.last + _EDGE_S + 1] = False
    return sorted(long + _find_spikes(size_um, mean_um, apart), key=lambda glitch: glitch.first)


def _largest_deviation(low_um: Column, mean_um: Column, high_um: Column) -> Column:
    """(n,) per second, the largest deviation of a reading from the surrounding seconds."""
    rows = np.arange(mean_um.size)
    there = np.isfinite(mean_um)
    base = ndimage.median_filter(
        np.interp(rows, rows[there], mean_um[there]), _BASE_S, mode="nearest"
    )
    above, below = high_um - base, base - low_um
    return np.where(above >= below, above, -below)


def _measure_size(glitch: Glitch, size_um: Column) -> Glitch:
    """Take the size of a short glitch from its readings: the mean of a second dilutes it."""
    if glitch.last - glitch.first > _BASE_S // 2:
        return glitch
    part = size_um[glitch.first - 1 : glitch.last + 2]
    return replace(glitch, size_um=float(part[np.nanargmax(np.abs(part))]))


def _find_spikes(size_um: Column, mean_um: Column, usable: BoolArray) -> list[Glitch]:
    """A reading far from the surrounding seconds, with the mirror unmoved before and after."""
    far = np.abs(size_um)
    usual = float(np.nanmedian(far))
    sigma = local_sigma(far - usual)
    moved = np.nan_to_num(np.abs(mean_differences(mean_um, 1, 1)))
    enough = np.fmax(GLITCH_LEAST_UM, GLITCH_LEAST_SIGMAS * sigma)
    found = np.flatnonzero((far - usual > enough) & (moved < _MOVED_MOST * far) & usable)
    found = found[np.concatenate(([True], np.diff(found) > 2))] if found.size else found
    score = (far - usual) / np.maximum(sigma, 1e-9)
    return [Glitch(int(row), int(row), float(size_um[row]), float(score[row])) for row in found]


def _find_edges(mean_um: Column, usable: BoolArray) -> list[Glitch]:
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


def _pair_edges(edges: list[Glitch]) -> list[Glitch]:
    """Pairs of opposite edges; unpaired edges are not glitches."""
    found: list[Glitch] = []
    for place, edge in enumerate(edges):
        if found and edge.first <= found[-1].last:
            continue
        back = _find_return_edge(edge, edges[place + 1 : place + 1 + GLITCH_LONGEST_S])
        if back is not None:
            found.append(Glitch(edge.first, back.first, edge.size_um, edge.sigmas))
    return found


def _find_return_edge(edge: Glitch, later: list[Glitch]) -> Glitch | None:
    """The largest opposite edge before the next equal one:
    a loop at full speed makes smaller ones.
    """
    best = None
    for other in later:
        if other.first > edge.first + GLITCH_LONGEST_S or _are_similar(edge.size_um, other.size_um):
            break
        if _are_similar(edge.size_um, -other.size_um) and (
            best is None or abs(other.size_um) > abs(best.size_um)
        ):
            best = other
    return best


def _are_similar(size_um: float, other_um: float) -> bool:
    return size_um * other_um > 0 and _EDGES_ALIKE <= abs(size_um / other_um) <= 1 / _EDGES_ALIKE
