"""Which ticks count as held: in `hold`, the setpoint ramp at its target, and that for some seconds."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.names import State
from membrane_ctrl.recording.summary import ARRIVED_UM, SETTLED_AFTER_S

Column = NDArray[np.float64]

FIELDS = ("mono_s", "state", "setpoint_um", "trim_um", "target_um")


class Settled:
    """The rule of `summary.json`, over blocks that come in their order."""

    def __init__(self) -> None:
        self._since_s = math.nan  # last moment that was not settled; NaN: not in hold

    def mask(self, block: Mapping[str, Column]) -> NDArray[np.bool_]:
        """(n,) true where the ticks of the next block are settled."""
        time_s = block["mono_s"]
        hold = block["state"] == State.HOLD
        ramp_um = block["setpoint_um"] - np.nan_to_num(block["trim_um"]) - block["target_um"]
        began = hold & ~np.concatenate(([not math.isnan(self._since_s)], hold[:-1]))
        moving = began | ~(np.abs(ramp_um) <= ARRIVED_UM)
        marks = np.where(hold & moving, time_s, -np.inf)
        if not math.isnan(self._since_s) and time_s.size and hold[0]:
            marks[0] = max(marks[0], self._since_s)
        since_s = np.maximum.accumulate(marks)
        settled = hold & (time_s - since_s >= SETTLED_AFTER_S)
        if time_s.size:
            self._since_s = float(since_s[-1]) if hold[-1] else math.nan
        return np.asarray(settled)


def held_at(level: Mapping[str, Column], time_s: Column) -> NDArray[np.bool_]:
    """(n,) whether the window of a level that holds each time, and the one before, were in `hold`."""
    if not level["time_s"].size:
        return np.zeros(time_s.size, dtype=bool)
    place = np.clip(np.searchsorted(level["time_s"], time_s, side="right") - 1, 0, None)
    hold = level["state"] == State.HOLD
    return np.asarray(hold[place] & hold[np.maximum(place - 1, 0)])
