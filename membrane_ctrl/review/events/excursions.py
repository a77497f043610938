"""Finds excursions: the error leaves the band without a known cause."""

from collections.abc import Sequence

import numpy as np

from membrane_ctrl.model.telemetry import State
from membrane_ctrl.review.events.found_event import FoundEvent, Level, find_stretches, widen_flags
from membrane_ctrl.review.events.steps import mean_differences

# After the cause: the time for the loop to return to the band (a leak of 1.2 µm/s and 40 µm: 32 s).
BACK_S = 30
# Means of this many seconds distinguish a ramping setpoint from noise.
RAMP_HALF_S = 5
# An event timed to a second may be detected some seconds after its effect begins.
TIMED_S = 5.0
# These are timed to minutes; they explain excursions within their range.
_TIMED_TO_MINUTES = ("flow step", "noise change")


def find_excursions(level: Level, band_um: float, known: Sequence[FoundEvent]) -> list[FoundEvent]:
    """Find where the 1 s mean of the error leaves the band without a fault, pause, ramp or event
    that explains it.

    Parameters
    ----------
    level : Level
        Columns of the 1 s level.
    band_um : float
        Half width of the band.
    known : sequence of FoundEvent
        Events that were found before.
    """
    time_s = level["time_s"]
    error_um = level["mean_error_um"]
    # Seconds beyond the band, without those that a fault, a pause or a ramp explains
    out = (np.abs(error_um) > band_um) & (level["state"] == State.HOLD)
    paused = np.isnan(level["mean_leak_um_per_s"])  # a loop that waits has no estimate of the leak
    setpoint_um = error_um + level["mean_displacement_um"]
    ramped = np.abs(mean_differences(setpoint_um, RAMP_HALF_S, 1)) > band_um
    out &= ~widen_flags((level["fault"] > 0) | paused | ramped, BACK_S)
    # and without those that a known event explains
    for event in known:
        if event.kind in _TIMED_TO_MINUTES:
            from_s = event.start_s
        else:
            from_s = event.time_s - TIMED_S
        first, end = np.searchsorted(time_s, [from_s, event.end_s + BACK_S])
        out[first:end] = False
    found = []
    for a, b in find_stretches(out, BACK_S):
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
