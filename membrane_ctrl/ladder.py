"""The ladder of safe actions: hold the last mean flow -> ramp down -> pump off -> vent.

A fault chooses the rung to enter at; each rung times out into the next; nothing but a clear observation on the
first rung leads back up. The time that the first rung lasts is a store that fills again only as fast as it is used:
a cause that comes and goes, and is there more than half of the time, times out as one that stays.
"""

from __future__ import annotations

from membrane_ctrl.config import StatesConfig
from membrane_ctrl.names import Rung


class Ladder:
    """Which safe action is in force, and since when."""

    def __init__(self, config: StatesConfig) -> None:
        self._limit_s = {
            Rung.HOLD_FLOW: config.hold_flow_max_s,
            Rung.RAMP_DOWN: config.ramp_down_s,
            Rung.PUMP_OFF: config.pump_off_max_s,
        }
        self.rung = Rung.NONE
        self._since_s = 0.0
        self._used_s = self._cleared_s = 0.0  # of HOLD_FLOW's time, when it was last left, and when that was

    def enter(self, rung: Rung, now_s: float) -> None:
        """Go to a rung, if it is further down than the present one."""
        if rung > self.rung:
            used_s = max(0.0, self._used_s - (now_s - self._cleared_s)) if rung == Rung.HOLD_FLOW else 0.0
            self.rung = rung
            self._since_s = now_s - used_s

    def clear(self, now_s: float) -> None:
        """Leave the ladder; only from HOLD_FLOW, as everything below is latched."""
        assert self.rung == Rung.HOLD_FLOW, self.rung
        self._used_s, self._cleared_s = self.age_s(now_s), now_s
        self.rung = Rung.NONE

    def leave(self) -> None:
        """Leave the ladder from wherever it is: a person has acknowledged, or the resume rule allows it."""
        self.rung, self._used_s = Rung.NONE, 0.0

    def age_s(self, now_s: float) -> float:
        """Time on the present rung; on HOLD_FLOW with what was left of earlier times there."""
        return now_s - self._since_s

    def step(self, now_s: float) -> Rung:
        """The rung in force now: a rung whose time is over gives way to the next."""
        limit_s = self._limit_s.get(self.rung)
        if limit_s is not None and self.age_s(now_s) > limit_s:
            self.enter(Rung(self.rung + 1), now_s)
        return self.rung
