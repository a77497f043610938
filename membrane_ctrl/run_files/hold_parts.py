"""What counts as held: in `hold`, the setpoint ramp at its target, no pause, no fault, and that for
some seconds.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model import telemetry
from membrane_ctrl.model.arrays import BoolArray, Column
from membrane_ctrl.model.state_tree import StateNode

FIELDS = (
    "mono_s",
    "state",
    "safe_level",
    "setpoint_um",
    "trim_um",
    "held_offset_um",
    "target_um",
    "displacement_um",
    "error_um",
    "p_um_per_s",
)
PARTS = ("held", "faults", "paused", "moving")
# The ramp has ended when setpoint minus trim is this near the target; far below the laser's 0.1 µm
# steps.
ARRIVED_UM = 0.01
# A mirror that was let go (a pause, a fault's mean flow) may have strayed: it counts again once it
# has stayed in the band, and after this time in any case.
_BACK_WITHIN_S = 60.0


@dataclass(slots=True)
class HoldParts(StateNode):
    """Parts of a run's ticks, over blocks that come in their order.

    `held` is the settled hold; `faults`: a safe level acts; `paused`; `moving`: in
    `hold`, the setpoint on its way, or not yet settled after that or after what let the mirror go.
    """

    band_um: float
    since_s: float = math.nan  # last unsettled time; NaN: not in hold
    let_go_s: float = math.nan  # last moment that nothing held it; NaN: it has been back since
    away_s: float = math.nan  # last moment that it was outside the band since

    def classify_block(self, block: Mapping[str, Column]) -> dict[str, BoolArray]:
        """(n,) masks of the next block by the names of `PARTS`; no tick is in two."""
        time_s = block["mono_s"]
        hold = block["state"] == telemetry.State.HOLD
        faults = block["safe_level"] > 0
        # a loop that follows its error has a proportional part; a lost reading alone is no pause
        open_loop = (
            (block["p_um_per_s"] == 0)
            & (block["error_um"] != 0)
            & np.isfinite(block["displacement_um"])
        )
        paused = hold & ~faults & open_loop
        # Ticks of `hold` in which the mirror is not settled: the first one, on the ramp, away
        shift_um = np.nan_to_num(block["trim_um"]) + np.nan_to_num(block["held_offset_um"])
        ramp_um = block["setpoint_um"] - shift_um - block["target_um"]
        arrived = np.abs(ramp_um) <= ARRIVED_UM
        was_in_hold = not math.isnan(self.since_s)
        began = hold & ~np.concatenate(([was_in_hold], hold[:-1]))
        away = paused | faults | self._find_straying(block, paused | (faults & hold))
        unsettled = hold & (began | away | ~arrived)
        # Settled: for some seconds after the last of them, which may be in an earlier block
        marks_s = np.where(unsettled, time_s, -np.inf)
        if was_in_hold and time_s.size and hold[0]:
            marks_s[0] = max(marks_s[0], self.since_s)
        since_s = np.maximum.accumulate(marks_s)
        held = hold & (time_s - since_s >= telemetry.SETTLED_AFTER_S)
        if time_s.size:
            self.since_s = float(since_s[-1]) if hold[-1] else math.nan
        return {
            "held": held,
            "faults": faults,
            "paused": paused,
            "moving": hold & ~(held | paused | faults),
        }

    def _find_straying(self, block: Mapping[str, Column], let_go: BoolArray) -> BoolArray:
        """(n,) the ticks outside the band from the moment that it is held again until it has stayed
        inside.
        """
        time_s = block["mono_s"]
        outside = ~(np.abs(block["error_um"]) <= self.band_um)
        straying = np.zeros(time_s.size, dtype=bool)
        was_let_go = np.concatenate(([not math.isnan(self.let_go_s)], let_go[:-1]))
        for first in np.flatnonzero(was_let_go & ~let_go):
            # When the mirror was last let go, and when it was last outside the band
            if first:
                let_go_s = time_s[first - 1]
                away_s = time_s[first - 1]
            else:
                let_go_s = self.let_go_s
                away_s = self.away_s
            # It strays until it has stayed in the band for some seconds, or the time has passed
            counts = outside & (time_s <= let_go_s + _BACK_WITHIN_S)
            rows = first + np.flatnonzero(counts[first:])
            outside_s = np.append(away_s, time_s[rows])
            inside_for_s = np.diff(outside_s, append=time_s[-1])
            stayed = np.flatnonzero(inside_for_s >= telemetry.SETTLED_AFTER_S)
            count = int(stayed[0]) if stayed.size else rows.size
            straying[rows[:count]] = True
            is_over = stayed.size or time_s[-1] > let_go_s + _BACK_WITHIN_S
            if is_over:
                self.let_go_s = math.nan
                self.away_s = math.nan
            else:
                self.let_go_s = float(let_go_s)
                self.away_s = float(outside_s[count])
        if let_go.size and let_go[-1]:
            self.let_go_s = self.away_s = float(time_s[-1])
        return straying


def held_at(level: Mapping[str, Column], time_s: Column) -> BoolArray:
    """Return whether the mirror was settled in `hold` at some times, to within a window of the
    level.

    Parameters
    ----------
    level : mapping of (windows,) arrays
        Columns of a level.
    time_s : (n,) array
        Times of the run.

    Returns
    -------
    (n,) bool array
        Times before the first window count as in it.
    """
    starts_s = level["time_s"]
    if not starts_s.size:
        return np.zeros(time_s.size, dtype=bool)
    window = np.searchsorted(starts_s, time_s, side="right") - 1
    window = np.clip(window, 0, None)
    # When the newest window of another state ended: since then the mirror has been in `hold`
    is_hold = level["state"] == telemetry.State.HOLD
    ends_s = np.append(starts_s[1:], np.inf)
    since_s = np.maximum.accumulate(np.where(is_hold, -np.inf, ends_s))
    is_settled = time_s - since_s[window] >= telemetry.SETTLED_AFTER_S
    return np.asarray(is_hold[window] & is_settled)
