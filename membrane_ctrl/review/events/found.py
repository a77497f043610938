"""Detects what a person would circle on a run's timeline, with time, size and confidence."""

from collections.abc import Callable, Iterable

import numpy as np

from membrane_ctrl.model.arrays import BoolArray
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.review.events import (
    door_steps,
    excursions,
    flow_steps,
    found_event,
    reading_glitches,
    shape_jumps,
    steps,
    trim_drifts,
)
from membrane_ctrl.run_files import hold_parts
from membrane_ctrl.run_files.shapes import Shapes

# Columns of the 1 s level used here.
LEVEL_COLUMNS = (
    "state",
    "fault",
    "min_ambient_pressure_pa",
    "mean_ambient_pressure_pa",
    "mean_flow_um_per_s",
    "mean_feedforward_um_per_s",
    "min_displacement_um",
    "mean_displacement_um",
    "max_displacement_um",
    "max_displacement_quality",
    "max_lateness_ms",
    "mean_error_um",
    "mean_air_temperature_c",
    "mean_leak_um_per_s",
    "mean_trim_um",
)
_WEATHER = {
    "mean_ambient_pressure_pa": "barometer lost",
    "mean_air_temperature_c": "thermometer lost",
}
# A door is 20 Pa; weather within two seconds is a few Pa (gusty: 1.8 Pa, 1 sigma).
DOOR_LEAST_PA = 6.0
DOOR_LEAST_SIGMAS = 5.5
# Time in which the loop returns the mirror after a door or missing readings.
DOOR_MOVES_S = 5
LOST_MOVES_S = 3
LATE_LEAST_MS = 5.0
LATE_LEAST_RATIO = 8.0
LATE_BURST_S = 10.0
LATE_BURST_LEAST = 3
# Noise 1.5 times higher, over ten minutes on both sides.
SPREAD_LEAST = np.log(1.5)
SPREAD_LEAST_SIGMAS = 6.0
SPREAD_HALF_MIN = 10


def find_events(
    level: found_event.Level, shapes: Shapes, band_um: float
) -> list[found_event.FoundEvent]:
    """All events of a run, in order of time.

    Parameters
    ----------
    level : dict
        The 1 s level (`Run.level(1.0)`).
    shapes : Shapes
        May be empty.
    band_um : float
        The run's `limits.band_um`: leaving it without another cause is an excursion.
    """
    found: list[found_event.FoundEvent] = []
    if level["time_s"].size:
        even = _fill_missing_seconds(level)
        finders: Iterable[Callable[[found_event.Level], list[found_event.FoundEvent]]] = (
            pressure_steps,
            find_laser_glitches,
            find_laser_losses,
            find_weather_losses,
            find_lateness_bursts,
            find_noise_changes,
        )
        for finder in finders:
            found += finder(even)
        held = _select_held(even)
        found += flow_steps.find_flow_steps(held)
        found += excursions.find_excursions(even, band_um, found)
        found += trim_drifts.find_trim_drifts(held)  # too slow to explain an excursion
    found += shape_jumps.shape_jumps(shapes, hold_parts.held_at(level, shapes.time_s))
    return sorted(found, key=lambda event: event.time_s)


def list_unjudged(level: found_event.Level) -> tuple[str, ...]:
    """Kinds of events that a run is too short to show, with the time that each needs."""
    held_s = 0.0
    if level["time_s"].size:
        held_s = float((level["state"] == State.HOLD).sum())
    needed_s = {
        f"flow step below {100 * flow_steps.SHORT_LEAST_SHARE:.0f} %": flow_steps.NEEDED_S,
        "noise change": 60.0 * (2 * SPREAD_HALF_MIN + 1),
        "drift of laser and optics": trim_drifts.NEEDED_S,
    }
    return tuple(
        f"{name} (needs {time_s / 60:.0f} min of hold)"
        for name, time_s in needed_s.items()
        if held_s < time_s
    )


def pressure_steps(level: found_event.Level) -> list[found_event.FoundEvent]:
    """Doors: steps of the air pressure within a few seconds."""
    values = level["mean_ambient_pressure_pa"]
    found = door_steps.find_door_steps(
        values, level["min_ambient_pressure_pa"], DOOR_LEAST_PA, DOOR_LEAST_SIGMAS
    )
    places = values.size * len(door_steps.LAGS)
    return [
        found_event.event_around(
            "pressure step", level, s.row, 1, s.size, "Pa", steps.step_confidence(s.sigmas, places)
        )
        for s in found
    ]


def find_laser_glitches(level: found_event.Level) -> list[found_event.FoundEvent]:
    """Readings that jump and jump back, not explained by air pressure or a lost laser."""
    # Seconds in which a lost laser or a step of the pressure explains a jump.
    lost = level["max_displacement_quality"] > 0
    barometer = level["mean_ambient_pressure_pa"]
    stepped = np.zeros(lost.size, dtype=bool)
    stepped[[round(step.time_s - level["time_s"][0]) for step in pressure_steps(level)]] = True
    # a slow barometer shows a door late
    slow_s = door_steps.update_s(barometer)
    stepped = found_event.widen_flags(stepped, DOOR_MOVES_S + (slow_s if slow_s > 1 else 0))
    usable = (
        (level["state"] == State.HOLD) & ~stepped & ~found_event.widen_flags(lost, LOST_MOVES_S)
    )
    calm = ~found_event.widen_flags(~np.isfinite(barometer), DOOR_MOVES_S)
    # Jumps and returns in the seconds that are left.
    low_um, mean_um, high_um = (level[f"{kind}_displacement_um"] for kind in ("min", "mean", "max"))
    found = reading_glitches.find_glitches(low_um, mean_um, high_um, usable, calm)
    time_s = level["time_s"]
    spans = [(float(time_s[g.first]), float(time_s[g.last])) for g in found]
    return [
        found_event.FoundEvent(
            "laser glitch",
            a_s,
            a_s - 30,
            b_s + 30,
            g.size_um,
            "µm",
            steps.step_confidence(g.sigmas, time_s.size),
        )
        for g, (a_s, b_s) in zip(found, spans, strict=True)
    ]


def find_laser_losses(level: found_event.Level) -> list[found_event.FoundEvent]:
    """The laser flagged its reading as bad, or gave none; on a bench held without one,
    the optics.
    """
    quality = level["max_displacement_quality"]
    seen = np.isfinite(level["mean_displacement_um"])
    bad = (quality > 0) | ~seen
    bad &= (level["state"] == State.HOLD) & (level["rows"] > 0)
    by_optics = seen.any() and not np.isfinite(quality).any()  # their readings have no code
    return _find_losses("optics lost" if by_optics else "laser lost", bad, level, 1)


def find_weather_losses(level: found_event.Level) -> list[found_event.FoundEvent]:
    """A barometer or thermometer stops giving values: the feed-forward then misses the weather."""
    found: list[found_event.FoundEvent] = []
    for name, kind in _WEATHER.items():
        there = np.isfinite(level[name])
        found += _find_losses(kind, ~there & (np.cumsum(there) > 0) & (level["rows"] > 0), level, 5)
    return found


def _find_losses(
    kind: str, lost: BoolArray, level: found_event.Level, join: int
) -> list[found_event.FoundEvent]:
    time_s = level["time_s"]
    return [
        found_event.FoundEvent(
            kind, float(time_s[a]), time_s[a] - 5, time_s[b] + 6, b - a + 1.0, "s", 1.0
        )
        for a, b in found_event.find_stretches(lost, join)
    ]


def find_lateness_bursts(level: found_event.Level) -> list[found_event.FoundEvent]:
    """Several late ticks close together; single ones occur on any machine."""
    worst = level["max_lateness_ms"]
    usual = 0.0
    if np.isfinite(worst).any():
        usual = float(np.nanmedian(worst))
    late = worst > max(LATE_LEAST_MS, LATE_LEAST_RATIO * usual)
    return [
        found_event.FoundEvent(
            "lateness burst",
            float(level["time_s"][a]),
            level["time_s"][a] - 5,
            level["time_s"][b] + 6,
            float(np.nanmax(worst[a : b + 1])),
            "ms",
            1.0,
        )
        for a, b in found_event.find_stretches(late, int(LATE_BURST_S))
        if int(late[a : b + 1].sum()) >= LATE_BURST_LEAST
    ]


def find_noise_changes(level: found_event.Level) -> list[found_event.FoundEvent]:
    """The spread of the error changes for minutes."""
    # Seconds of the held mirror, numbered by their minute from the first one on.
    held = _select_held(level)
    minute = np.floor(held["time_s"] / 60).astype(int)
    error = held["mean_error_um"]
    there = np.isfinite(error)
    if not there.any():
        return []
    first = minute[0]
    size = minute[-1] - first + 1
    number = minute[there] - first
    error = error[there]

    # Standard deviation of the error within each minute.
    count = np.bincount(number, minlength=size)
    mean = np.bincount(number, error, size) / np.maximum(count, 1)
    squares = np.bincount(number, (error - mean[number]) ** 2, size)
    spread = np.sqrt(squares / np.maximum(count, 1))

    # Its logarithm, so that a step is a factor; minutes with few seconds do not count.
    value = np.where((count >= 50) & (spread > 0), np.log(np.maximum(spread, 1e-12)), np.nan)
    found = steps.find_steps(
        value, SPREAD_HALF_MIN, 1, least=float(SPREAD_LEAST), least_sigmas=SPREAD_LEAST_SIGMAS
    )
    time_s = {"time_s": (first + np.arange(size)) * 60.0}
    return [
        found_event.event_around(
            "noise change",
            time_s,
            s.row,
            60,
            float(np.exp(s.size)),
            "times",
            steps.step_confidence(s.sigmas, size),
        )
        for s in found
    ]


def _select_held(level: found_event.Level) -> found_event.Level:
    """The level with NaN where the mirror was not held,
    so that the start of a hold is not a step.
    """
    held = level["state"] == State.HOLD
    kept = {"time_s", "rows", "state"}
    return {
        name: values if name in kept else np.where(held, values, np.nan)
        for name, values in level.items()
    }


def _fill_missing_seconds(level: found_event.Level) -> found_event.Level:
    """The level with a row for every second; NaN for missing ones."""
    # The row of each second, counted from the first one.
    second = np.rint(level["time_s"]).astype(np.int64)
    place = second - second[0]
    size = int(place[-1]) + 1
    if size == second.size:
        return level

    # All columns on these rows. Missing seconds have their time, and no ticks.
    even: found_event.Level = {}
    for name, values in level.items():
        even[name] = np.full(size, np.nan)
        even[name][place] = values
    even["time_s"] = (second[0] + np.arange(size)).astype(np.float64)
    even["rows"] = np.nan_to_num(even["rows"])
    return even
