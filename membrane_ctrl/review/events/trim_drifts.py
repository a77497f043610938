"""Slow motions between laser and optics, which the shape loop corrects with its trim: the laser's
mount or the camera moved.
"""

from __future__ import annotations

import math

import numpy as np

from membrane_ctrl.review.events import found_event, steps
from membrane_ctrl.run_files import levels

LEAST_UM = 5.0
LEAST_SIGMAS = 6.0
LEAST_MIN = 5  # held minutes
NEEDED_S = 60.0 * LEAST_MIN


def find_trim_drifts(held: found_event.Level) -> list[found_event.FoundEvent]:
    """The change of the trim over the hold, if it is far above a random walk with the steps from
    minute to minute.

    Parameters
    ----------
    held : dict
        The 1 s level, NaN where the mirror was not held.
    """
    # Minute means of the trim while the mirror was held.
    minutes = levels.coarser_level(held, 60.0)
    trim_um = minutes["mean_trim_um"]
    time_s = minutes["time_s"]
    known = np.flatnonzero(np.isfinite(trim_um))
    if known.size < LEAST_MIN:
        return []
    # A random walk with these steps would go as far as the root of their number.
    change_um = float(trim_um[known[-1]] - trim_um[known[0]])
    increments_um = np.diff(trim_um[known])
    spread_um = float(np.median(np.abs(increments_um - np.median(increments_um)))) / 0.6745
    sigmas = abs(change_um) / max(spread_um * math.sqrt(increments_um.size), 1e-9)
    if abs(change_um) < LEAST_UM or sigmas < LEAST_SIGMAS:
        return []
    # The event is placed where half of the change is over.
    half = trim_um[known[0]] + 0.5 * change_um
    place = known[int(np.argmin(np.abs(trim_um[known] - half)))]
    return [
        found_event.FoundEvent(
            "laser and optics drift apart",
            float(time_s[place]),
            float(time_s[known[0]]),
            float(time_s[known[-1]]) + 60.0,
            change_um,
            "µm",
            steps.step_confidence(sigmas, 1),
        )
    ]
