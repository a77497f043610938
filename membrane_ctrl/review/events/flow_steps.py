"""Steps of the flow that holds the mirror: the leak changed, or what the pump gives.

The flow that the loop commands, less the feed-forward, balances the leak. It rises if the leak
grows, and also if the pump gives less than its curve; the flow alone cannot distinguish the two.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import special

from membrane_ctrl.model.arrays import Column
from membrane_ctrl.review.events import found_event, steps
from membrane_ctrl.run_files import levels

# Means of five minutes resolve a tenth of the leak; a quarter matters to the hold.
LEAST_SHARE = 0.2
LEAST_UM_PER_S = 0.03
LEAST_SIGMAS = 6.0
HALF_MIN = 5
# A run that is too short for these: half minutes of 5 s means, whose own scatter is the noise. The
# loop makes the means nearly independent (its time constant is 1.45 s).
SHORT_WINDOW_S = 5.0
SHORT_HALF = 6
SHORT_LEAST_SHARE = 0.5
SHORT_LEAST_UM_PER_S = 0.3
SHORT_LEAST_T = 8.0
NEEDED_S = 60.0 * (2 * HALF_MIN + 1)


def find_flow_steps(held: found_event.Level) -> list[found_event.FoundEvent]:
    """Steps of the holding flow that the weather (the feed-forward) does not explain.

    Parameters
    ----------
    held : dict
        The 1 s level, NaN where the mirror was not held.
    """
    held_s = float(np.isfinite(held["mean_flow_um_per_s"]).sum())
    if held_s >= NEEDED_S:
        return _find_long_steps(held)
    return _find_short_steps(held)


def _holding_flow(level: found_event.Level) -> Column:
    """Flow less feed-forward; NaN in windows that are not whole."""
    whole = level["rows"] > 0.5 * np.nanmedian(level["rows"])
    flow = level["mean_flow_um_per_s"] - np.nan_to_num(level["mean_feedforward_um_per_s"])
    return np.where(whole, flow, np.nan)


def _find_long_steps(held: found_event.Level) -> list[found_event.FoundEvent]:
    minutes = levels.coarser_level(held, 60.0)
    flow = _holding_flow(minutes)
    if not np.isfinite(flow).any():
        return []
    found = steps.find_steps(
        flow, half=HALF_MIN, skip=1, least=LEAST_UM_PER_S, least_sigmas=LEAST_SIGMAS
    )
    before = [float(np.nanmean(flow[max(0, s.row - HALF_MIN) : s.row])) for s in found]
    return [
        found_event.event_around(
            "flow step",
            minutes,
            s.row,
            60,
            100 * s.size / old,
            "%",
            steps.step_confidence(s.sigmas, flow.size),
        )
        for s, old in zip(found, before, strict=True)
        if old > 0 and abs(s.size) >= LEAST_SHARE * old
    ]


def _find_short_steps(held: found_event.Level) -> list[found_event.FoundEvent]:
    """The largest step, if it is far above the scatter on both sides."""
    # Student's t of the flow after each window against the flow before it; the place where it is
    # largest.
    windows = levels.coarser_level(held, SHORT_WINDOW_S)
    flow = _holding_flow(windows)
    places = range(SHORT_HALF, flow.size - SHORT_HALF)
    judged = [place for place in places if math.isfinite(_t_value(flow, place)[1])]
    if not judged:
        return []
    best = max(judged, key=lambda place: abs(_t_value(flow, place)[0]))

    # It must be large against the flow itself, and against the scatter.
    size, t_value = _t_value(flow, best)
    old = float(flow[best - SHORT_HALF : best].mean())
    least = max(SHORT_LEAST_UM_PER_S, SHORT_LEAST_SHARE * old)
    if old <= 0 or abs(size) < least or t_value < SHORT_LEAST_T:
        return []

    # Chance of so large a t value at any of the places, to either side.
    chance = 2.0 * len(judged) * float(special.stdtr(2 * SHORT_HALF - 2, -t_value))
    event = found_event.event_around(
        "flow step", windows, best, SHORT_WINDOW_S, 100 * size / old, "%", max(0.0, 1.0 - chance)
    )
    return [event]


def _t_value(flow: Column, place: int) -> tuple[float, float]:
    """Step at a place, whose own window is skipped, and its size over its standard error."""
    before = flow[place - SHORT_HALF : place]
    after = flow[place + 1 : place + 1 + SHORT_HALF]
    size = float(after.mean() - before.mean())
    error = math.sqrt((before.var(ddof=1) + after.var(ddof=1)) / SHORT_HALF)
    if not math.isfinite(size) or not error > 0.0:
        return math.nan, math.nan
    return size, abs(size) / error
