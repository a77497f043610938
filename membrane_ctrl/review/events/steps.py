"""Steps in a noisy series: the mean after a place compared with the mean before it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, special

from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.arrays import BoolArray, Column, FloatArray
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.run_files.shapes import Shapes

# The noise is estimated over stretches of this many values: weather changes over a night.
_STRETCH = 3600


@dataclass(frozen=True, slots=True)
class FoundStep:
    """A detected step."""

    row: int  # place in the series
    size: float  # after minus before, in the series' unit
    sigmas: float  # its size over the noise of such differences


def steps(
    values: Column, half: int, skip: int, least: float, least_sigmas: float
) -> list[FoundStep]:
    """Steps of at least `least` and `least_sigmas`, each once.

    Parameters
    ----------
    values : (n,) array
        Equally spaced; NaN for gaps, which no step crosses.
    half : int
        Values averaged on each side.
    skip : int
        Values skipped between the sides: the longest duration of a step.
    least : float
        In the unit of the values.
    least_sigmas : float
        Relative to the robust spread of nearby differences.
    """
    difference = differences(values, half, skip)
    sigma = local_sigma(difference)
    size = np.nan_to_num(np.abs(difference))
    score = np.where(sigma > 0, size / np.maximum(sigma, 1e-300), np.inf)
    found = (size >= least) & (score >= least_sigmas)
    # the largest within reach represents the whole step
    reach = 2 * half + skip
    peak = found & (size >= ndimage.maximum_filter1d(size, 2 * reach + 1, mode="constant"))
    rows = np.flatnonzero(peak)
    if rows.size:
        rows = rows[np.concatenate(([True], np.diff(rows) > reach))]
    return [FoundStep(int(row), float(difference[row]), float(score[row])) for row in rows]


def differences(values: Column, half: int, skip: int) -> Column:
    """(n,) mean of the `half` values after a place minus that before it; NaN at the ends and at
    gaps.
    """
    result = np.full(values.size, np.nan)
    span = 2 * half + skip
    if values.size < span:
        return result
    windows = np.lib.stride_tricks.sliding_window_view(
        np.asarray(values, dtype=np.float64), half
    ).mean(axis=1)
    middle = half + skip // 2
    count = values.size - span + 1
    result[middle : middle + count] = windows[half + skip :][:count] - windows[:count]
    return result


def local_sigma(values: Column, share: float = 0.5) -> Column:
    """(n,) robust standard deviation of stretches of the series, constant within each, about 0.

    The quantile `share` of the absolute values is compared with that of a normal distribution. Half
    (the median) is the most robust, but fails for values that mostly repeat.
    """
    result = np.full(values.size, np.nan)
    sigmas = float(special.ndtri(0.5 * (1 + share)))
    for first in range(0, values.size, _STRETCH):
        # the last stretch is full-length too
        start = max(0, min(first, values.size - _STRETCH))
        part = values[start : first + _STRETCH]
        part = np.abs(part[np.isfinite(part)])
        result[first : first + _STRETCH] = (
            np.quantile(part, share) / sigmas if part.size else np.nan
        )
    return result


def confidence(sigmas: float, looked_at: int) -> float:
    """1 minus the probability that (normal) noise alone makes a step this high anywhere in
    `looked_at` places.
    """
    return float(max(0.0, 1.0 - looked_at * special.erfc(sigmas / np.sqrt(2))))


Level = dict[str, FloatArray]


@dataclass(frozen=True, slots=True)
class FoundEvent:
    """A detected event."""

    # "pressure step", "leak step", "laser glitch", "laser lost", "optics lost", "barometer lost",
    # "thermometer lost", "lateness burst", "noise change", "shape jump" or "excursion"
    kind: str
    time_s: float  # time of the event
    start_s: float  # time range of the run that shows it
    end_s: float
    size: float  # in `unit`
    unit: str
    confidence: (
        float  # 1 minus the probability that noise alone looks like this somewhere in the run
    )


def event_around(
    kind: str, table: Level, row: int, half_s: float, size: float, unit: str, sure: float
) -> FoundEvent:
    """An event with a time range of several detection windows around it."""
    time_s = float(table["time_s"][row])
    return FoundEvent(
        kind, time_s, time_s - 30 * half_s**0.5, time_s + 30 * half_s**0.5, size, unit, sure
    )


def widened(flags: BoolArray, rows: int) -> BoolArray:
    """True flags, widened by `rows` on each side."""
    return np.asarray(
        ndimage.maximum_filter1d(flags, 2 * rows + 1, mode="constant", cval=0), dtype=bool
    )


def runs(flags: BoolArray, join: int) -> list[tuple[int, int]]:
    """First and last row of each stretch of true rows, joining those at most `join` apart."""
    rows = np.flatnonzero(flags)
    if not rows.size:
        return []
    parts = np.split(rows, np.flatnonzero(np.diff(rows) > join) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts]


# After the cause: the time for the loop to return to the band (a leak of 1.2 µm/s and 40 µm: 32 s).
BACK_S = 30
# Means of this many seconds distinguish a ramping setpoint from noise.
RAMP_HALF_S = 5
# An event timed to a second may be detected some seconds after its effect begins.
TIMED_S = 5.0
# These are timed to minutes; they explain excursions within their range.
_TIMED_TO_MINUTES = ("leak step", "noise change")


def excursions(level: Level, band_um: float, known: Sequence[FoundEvent]) -> list[FoundEvent]:
    """The 1 s mean of the error leaves the band without a fault, pause, ramp or event that explains
    it.
    """
    time_s, error_um = level["time_s"], level["mean_error_um"]
    out = (np.abs(error_um) > band_um) & (level["state"] == State.HOLD)
    paused = np.isnan(level["mean_leak_um_per_s"])  # a loop that waits has no estimate of the leak
    setpoint_um = error_um + level["mean_displacement_um"]
    ramped = np.abs(differences(setpoint_um, RAMP_HALF_S, 1)) > band_um
    out &= ~widened((level["fault"] > 0) | paused | ramped, BACK_S)
    for event in known:
        from_s = event.start_s if event.kind in _TIMED_TO_MINUTES else event.time_s - TIMED_S
        first, end = np.searchsorted(time_s, [from_s, event.end_s + BACK_S])
        out[first:end] = False
    found = []
    for a, b in runs(out, BACK_S):
        worst = a + int(np.nanargmax(np.abs(error_um[a : b + 1])))
        found.append(
            FoundEvent(
                "excursion",
                float(time_s[a]),
                float(time_s[a]) - 30,
                float(time_s[b]) + 30,
                float(error_um[worst]),
                "µm",
                1.0,
            )
        )
    return found


JUMP_LEAST_UM = 0.3
JUMP_LEAST_SIGMAS = 8.0
JUMP_HALF_CYCLES = 5
# Between cycles; a setpoint's ramp is faster, and frames of a moving mirror are inconsistent.
JUMP_STILL_UM = 2.0
# Standard deviation over median absolute deviation, of normal noise.
_SIGMA_OVER_MAD = 1.4826


def shape_jumps(shapes: Shapes, held: BoolArray) -> list[FoundEvent]:
    """Steps of the figure between cycles (terms 5 to 11, less the share of a deeper bowl)."""
    moved_um = np.abs(np.diff(shapes.displacement_um, prepend=np.nan, append=np.nan))
    still = ~(np.fmax(moved_um[:-1], moved_um[1:]) > JUMP_STILL_UM)
    good = held & still & (shapes.verdict != "rejected")
    if np.count_nonzero(good) < 4 * JUMP_HALF_CYCLES:
        return []
    # all terms of a month take 190 MB (36 of them)
    terms = shapes.coeffs_um[good, 4:11] - np.outer(shapes.sag_um[good], zernike_projection()[4:11])
    change = np.stack([differences(term, JUMP_HALF_CYCLES, 0) for term in terms.T])
    size = np.sqrt((change**2).sum(axis=0))
    scale = np.nanmedian(size)
    sigma = _SIGMA_OVER_MAD * float(np.nanmedian(np.abs(size - scale))) + 1e-12
    score = np.nan_to_num((size - scale) / sigma)
    rows = np.flatnonzero((np.nan_to_num(size) >= JUMP_LEAST_UM) & (score >= JUMP_LEAST_SIGMAS))
    groups = (
        np.split(rows, np.flatnonzero(np.diff(rows) > 2 * JUMP_HALF_CYCLES) + 1)
        if rows.size
        else []
    )
    best = [int(group[np.argmax(size[group])]) for group in groups]
    time_s = {"time_s": shapes.time_s[good]}
    return [
        event_around(
            "shape jump",
            time_s,
            row,
            60,
            float(size[row]),
            "µm",
            confidence(float(score[row]), size.size),
        )
        for row in best
    ]
