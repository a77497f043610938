"""Times out of the band that nothing else of the run explains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from membrane_ctrl.names import State
from membrane_ctrl.review.found_event import Found, Level, runs, widened
from membrane_ctrl.review.steps import differences

# After what explains it: what the loop needs to be back in the band (a leak of 1.2 um/s and 40 um: 32 s).
BACK_S = 30
# Means of so many seconds tell a setpoint on its way from noise.
RAMP_HALF_S = 5
# An event timed to a second may be found some after its effect begins.
TIMED_S = 5.0
# These are timed to minutes; what they explain is within their range.
_TIMED_TO_MINUTES = ("leak step", "noise change")


def excursions(level: Level, band_um: float, known: Sequence[Found]) -> list[Found]:
    """The 1 s mean of the error leaves the band, and no fault, pause, ramp or event known explains it."""
    time_s, error_um = level["time_s"], level["mean_error_um"]
    out = (np.abs(error_um) > band_um) & (level["state"] == State.HOLD)
    paused = np.diff(error_um, prepend=np.nan) == 0  # a loop that waits repeats its error
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
        found.append(Found("excursion", float(time_s[a]), float(time_s[a]) - 30, float(time_s[b]) + 30,
                           float(error_um[worst]), "um", 1.0))  # fmt: skip
    return found
