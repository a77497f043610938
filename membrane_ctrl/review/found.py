"""Events found by machine: what a person would circle on the timeline, with time, size and confidence."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from membrane_ctrl.metrology.hencky import zernike_projection
from membrane_ctrl.names import State
from membrane_ctrl.recording.levels import coarser_level
from membrane_ctrl.review.door_steps import door_steps, looked_at, update_s
from membrane_ctrl.review.laser_jumps import glitches
from membrane_ctrl.review.settled import held_at
from membrane_ctrl.review.shapes import Shapes
from membrane_ctrl.review.steps import confidence, differences, steps

Column = NDArray[np.float64]
Level = dict[str, Column]

# Columns of the 1 s level that are looked at.
LEVEL_COLUMNS = (
    "state", "fault", "min_ambient_pressure_pa", "mean_ambient_pressure_pa", "mean_flow_um_per_s",
    "mean_feedforward_um_per_s", "min_displacement_um", "mean_displacement_um", "max_displacement_um",
    "max_displacement_quality", "max_lateness_ms", "mean_error_um", "mean_air_temperature_c",
)  # fmt: skip
_WEATHER = {"mean_ambient_pressure_pa": "barometer lost", "mean_air_temperature_c": "thermometer lost"}
# A door is 20 Pa, weather within two seconds a few Pa (gusty: 1.8 Pa, 1 sigma).
DOOR_LEAST_PA = 6.0
DOOR_LEAST_SIGMAS = 5.5
# Means of five minutes tell a tenth of the leak; what matters to the hold is a quarter.
LEAK_LEAST_SHARE = 0.2
LEAK_LEAST_UM_PER_S = 0.03
LEAK_LEAST_SIGMAS = 6.0
LEAK_HALF_MIN = 5
# The loop brings the mirror back after a door, and after a time without a reading.
DOOR_MOVES_S = 5
LOST_MOVES_S = 3
LATE_LEAST_MS = 5.0
LATE_LEAST_RATIO = 8.0
LATE_BURST_S = 10.0
LATE_BURST_LEAST = 3
# Half as much noise again, over ten minutes on both sides.
SPREAD_LEAST = np.log(1.5)
SPREAD_LEAST_SIGMAS = 6.0
SPREAD_HALF_MIN = 10
JUMP_LEAST_UM = 0.3
JUMP_LEAST_SIGMAS = 8.0
JUMP_HALF_CYCLES = 5
# From cycle to cycle; a setpoint's ramp is faster, and frames of a mirror that moves do not fit each other.
JUMP_STILL_UM = 2.0
# After what explains it: what the loop needs to be back in the band (a leak of 1.2 um/s and 40 um: 32 s).
BACK_S = 30
# Means of so many seconds tell a setpoint on its way from noise.
RAMP_HALF_S = 5
# An event timed to a second may be found some after its effect begins.
TIMED_S = 5.0
# These are timed to minutes; what they explain is within their range.
_TIMED_TO_MINUTES = ("leak step", "noise change")
# Robust sigma of a greatest-of-a-second is taken about its median.
_SIGMA_OVER_MAD = 1.4826


@dataclass(frozen=True, slots=True)
class Found:
    """An event that nobody reported.

    Attributes
    ----------
    kind : str
        "pressure step", "leak step", "laser glitch", "laser lost", "barometer lost", "thermometer lost",
        "lateness burst", "noise change", "shape jump" or "excursion".
    start_s, end_s : float
        Time range of the run that shows it.
    time_s : float
        When it happened.
    size : float
        In `unit`.
    unit : str
    confidence : float
        1 minus the chance that noise alone looks like this somewhere in the run.
    """

    kind: str
    time_s: float
    start_s: float
    end_s: float
    size: float
    unit: str
    confidence: float


def find_events(level: Level, shapes: Shapes, band_um: float) -> list[Found]:
    """All events of a run in the order of time.

    Parameters
    ----------
    level : dict
        The 1 s level (`Run.level(1.0)`).
    shapes : Shapes
        May be empty.
    band_um : float
        The run's `limits.band_um`: what leaves it for no other reason is an excursion.
    """
    found: list[Found] = []
    if level["time_s"].size:
        even = _even(level)
        finders: Iterable[Callable[[Level], list[Found]]] = (
            pressure_steps, leak_steps, laser_glitches, laser_losses, weather_losses, lateness_bursts,
            noise_changes,
        )  # fmt: skip
        for finder in finders:
            found += finder(even)
        found += excursions(even, band_um, found)
    found += shape_jumps(shapes, held_at(level, shapes.time_s))
    return sorted(found, key=lambda event: event.time_s)


def pressure_steps(level: Level) -> list[Found]:
    """Doors: the air pressure steps within some seconds."""
    values = level["mean_ambient_pressure_pa"]
    found = door_steps(values, level["min_ambient_pressure_pa"], DOOR_LEAST_PA, DOOR_LEAST_SIGMAS)
    places = looked_at(values.size)
    return [_event("pressure step", level, s.row, 1, s.size, "Pa", confidence(s.sigmas, places)) for s in found]


def leak_steps(level: Level) -> list[Found]:
    """The flow that holds the mirror steps, and the weather (what is fed forward) does not explain it."""
    minutes = coarser_level(_held(level), 60.0)
    whole = minutes["rows"] > 0.5 * np.nanmedian(minutes["rows"])
    leak = minutes["mean_flow_um_per_s"] - np.nan_to_num(minutes["mean_feedforward_um_per_s"])
    leak = np.where(whole, leak, np.nan)
    if not np.isfinite(leak).any():
        return []
    found = steps(leak, half=LEAK_HALF_MIN, skip=1, least=LEAK_LEAST_UM_PER_S, least_sigmas=LEAK_LEAST_SIGMAS)
    before = [float(np.nanmean(leak[max(0, s.row - LEAK_HALF_MIN) : s.row])) for s in found]
    return [
        _event("leak step", minutes, s.row, 60, 100 * s.size / old, "%", confidence(s.sigmas, leak.size))
        for s, old in zip(found, before, strict=True)
        if old > 0 and abs(s.size) >= LEAK_LEAST_SHARE * old
    ]


def laser_glitches(level: Level) -> list[Found]:
    """Readings that jump and jump back, while neither the air pressure nor a loss of the laser explains it."""
    lost = level["max_displacement_quality"] > 0
    barometer = level["mean_ambient_pressure_pa"]
    stepped = np.zeros(lost.size, dtype=bool)
    stepped[[round(step.time_s - level["time_s"][0]) for step in pressure_steps(level)]] = True
    # a slow barometer tells of a door when it comes to it
    stepped = _widened(stepped, DOOR_MOVES_S + (update_s(barometer) if update_s(barometer) > 1 else 0))
    usable = (level["state"] == State.HOLD) & ~stepped & ~_widened(lost, LOST_MOVES_S)
    calm = ~_widened(~np.isfinite(barometer), DOOR_MOVES_S)
    low_um, mean_um, high_um = (level[f"{kind}_displacement_um"] for kind in ("min", "mean", "max"))
    found = glitches(low_um, mean_um, high_um, usable, calm)
    time_s = level["time_s"]
    return [
        Found("laser glitch", float(time_s[g.first]), float(time_s[g.first]) - 30, float(time_s[g.last]) + 30,
              g.size_um, "um", confidence(g.sigmas, time_s.size))
        for g in found
    ]  # fmt: skip


def laser_losses(level: Level) -> list[Found]:
    """The laser said that its reading is no good, or gave none."""
    bad = (level["max_displacement_quality"] > 0) | ~np.isfinite(level["mean_displacement_um"])
    bad &= (level["state"] == State.HOLD) & (level["rows"] > 0)
    return _losses("laser lost", bad, level, 1)


def weather_losses(level: Level) -> list[Found]:
    """A barometer or thermometer that has given values gives none: what is fed forward then misses the weather."""
    found: list[Found] = []
    for name, kind in _WEATHER.items():
        there = np.isfinite(level[name])
        found += _losses(kind, ~there & (np.cumsum(there) > 0) & (level["rows"] > 0), level, 5)
    return found


def _losses(kind: str, lost: NDArray[np.bool_], level: Level, join: int) -> list[Found]:
    time_s = level["time_s"]
    return [Found(kind, float(time_s[a]), time_s[a] - 5, time_s[b] + 6, b - a + 1.0, "s", 1.0)
            for a, b in _runs(lost, join)]  # fmt: skip


def lateness_bursts(level: Level) -> list[Found]:
    """Several late ticks close together; a single one is any machine's."""
    worst = level["max_lateness_ms"]
    usual = float(np.nanmedian(worst)) if np.isfinite(worst).any() else 0.0
    late = worst > max(LATE_LEAST_MS, LATE_LEAST_RATIO * usual)
    return [
        Found("lateness burst", float(level["time_s"][a]), level["time_s"][a] - 5, level["time_s"][b] + 6,
              float(np.nanmax(worst[a : b + 1])), "ms", 1.0)
        for a, b in _runs(late, int(LATE_BURST_S))
        if int(late[a : b + 1].sum()) >= LATE_BURST_LEAST
    ]  # fmt: skip


def noise_changes(level: Level) -> list[Found]:
    """The spread of the error changes for minutes."""
    held = _held(level)
    minute = np.floor(held["time_s"] / 60).astype(int)
    error = held["mean_error_um"]
    there = np.isfinite(error)
    if not there.any():
        return []
    first, size = minute[0], minute[-1] - minute[0] + 1
    number, error = minute[there] - first, error[there]
    count = np.bincount(number, minlength=size)
    mean = np.bincount(number, error, size) / np.maximum(count, 1)
    spread = np.sqrt(np.bincount(number, (error - mean[number]) ** 2, size) / np.maximum(count, 1))
    value = np.where((count >= 50) & (spread > 0), np.log(np.maximum(spread, 1e-12)), np.nan)
    found = steps(value, SPREAD_HALF_MIN, 1, least=float(SPREAD_LEAST), least_sigmas=SPREAD_LEAST_SIGMAS)
    time_s = {"time_s": (first + np.arange(size)) * 60.0}
    return [
        _event("noise change", time_s, s.row, 60, float(np.exp(s.size)), "times", confidence(s.sigmas, size))
        for s in found
    ]


def excursions(level: Level, band_um: float, known: Sequence[Found]) -> list[Found]:
    """The 1 s mean of the error leaves the band, and no fault, pause, ramp or event known explains it."""
    time_s, error_um = level["time_s"], level["mean_error_um"]
    out = (np.abs(error_um) > band_um) & (level["state"] == State.HOLD)
    paused = np.diff(error_um, prepend=np.nan) == 0  # a loop that waits repeats its error
    setpoint_um = error_um + level["mean_displacement_um"]
    ramped = np.abs(differences(setpoint_um, RAMP_HALF_S, 1)) > band_um
    out &= ~_widened((level["fault"] > 0) | paused | ramped, BACK_S)
    for event in known:
        from_s = event.start_s if event.kind in _TIMED_TO_MINUTES else event.time_s - TIMED_S
        first, end = np.searchsorted(time_s, [from_s, event.end_s + BACK_S])
        out[first:end] = False
    found = []
    for a, b in _runs(out, BACK_S):
        worst = a + int(np.nanargmax(np.abs(error_um[a : b + 1])))
        found.append(Found("excursion", float(time_s[a]), float(time_s[a]) - 30, float(time_s[b]) + 30,
                           float(error_um[worst]), "um", 1.0))  # fmt: skip
    return found


def shape_jumps(shapes: Shapes, held: NDArray[np.bool_]) -> list[Found]:
    """The figure beside its sag (terms 5 to 11, without what a deeper bowl has of them) steps between cycles."""
    moved_um = np.abs(np.diff(shapes.displacement_um, prepend=np.nan, append=np.nan))
    still = ~(np.fmax(moved_um[:-1], moved_um[1:]) > JUMP_STILL_UM)
    good = held & still & (shapes.verdict != "rejected")
    if np.count_nonzero(good) < 4 * JUMP_HALF_CYCLES:
        return []
    # of a month all 36 terms are 190 MB
    terms = shapes.coeffs_um[good, 4:11] - np.outer(shapes.sag_um[good], zernike_projection()[4:11])
    change = np.stack([differences(term, JUMP_HALF_CYCLES, 0) for term in terms.T])
    size = np.sqrt((change**2).sum(axis=0))
    scale = np.nanmedian(size)
    sigma = _SIGMA_OVER_MAD * float(np.nanmedian(np.abs(size - scale))) + 1e-12
    score = np.nan_to_num((size - scale) / sigma)
    rows = np.flatnonzero((np.nan_to_num(size) >= JUMP_LEAST_UM) & (score >= JUMP_LEAST_SIGMAS))
    groups = np.split(rows, np.flatnonzero(np.diff(rows) > 2 * JUMP_HALF_CYCLES) + 1) if rows.size else []
    best = [int(group[np.argmax(size[group])]) for group in groups]
    time_s = {"time_s": shapes.time_s[good]}
    return [
        _event("shape jump", time_s, row, 60, float(size[row]), "um", confidence(float(score[row]), size.size))
        for row in best
    ]


def _event(kind: str, table: Level, row: int, half_s: float, size: float, unit: str, sure: float) -> Found:
    """An event with a range about it of some times what it was found in."""
    time_s = float(table["time_s"][row])
    return Found(kind, time_s, time_s - 30 * half_s**0.5, time_s + 30 * half_s**0.5, size, unit, sure)


def _widened(flags: NDArray[np.bool_], rows: int) -> NDArray[np.bool_]:
    """True rows and so many on each side of them."""
    return np.asarray(ndimage.maximum_filter1d(flags, 2 * rows + 1, mode="constant", cval=0), dtype=bool)


def _runs(flags: NDArray[np.bool_], join: int) -> list[tuple[int, int]]:
    """First and last row of each stretch of true rows; those `join` or fewer apart are one."""
    rows = np.flatnonzero(flags)
    if not rows.size:
        return []
    parts = np.split(rows, np.flatnonzero(np.diff(rows) > join) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts]


def _held(level: Level) -> Level:
    """The level with NaN where the mirror was not held, so that no step is seen where a hold begins."""
    held = level["state"] == State.HOLD
    kept = {"time_s", "rows", "state"}
    return {name: values if name in kept else np.where(held, values, np.nan) for name, values in level.items()}


def _even(level: Level) -> Level:
    """The level with a row for every second; NaN where the run has none."""
    second = np.rint(level["time_s"]).astype(np.int64)
    place = second - second[0]
    size = int(place[-1]) + 1
    if size == second.size:
        return level
    even: Level = {}
    for name, values in level.items():
        even[name] = np.full(size, np.nan)
        even[name][place] = values
    even["time_s"] = (second[0] + np.arange(size)).astype(np.float64)
    even["rows"] = np.nan_to_num(even["rows"])
    return even
