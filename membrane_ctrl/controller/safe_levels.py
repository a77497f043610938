"""The safe levels: hold the last mean flow -> ramp down -> pump off -> vent.

A fault chooses the level to enter; each level times out into the next; only a clear observation on
the first level leads back up. The first level's time recovers only as fast as it is used, so a
cause present more than half of the time also times out.
"""

from dataclasses import dataclass

from firmware_iface.register_map import load_default_map
from membrane_ctrl.config.schema import StatesConfig
from membrane_ctrl.model.state_tree import StateNode
from membrane_ctrl.model.telemetry import SafeLevel

DAY_S = 86_400.0
WATCHDOG_MASK = load_default_map().make_fault_mask("watchdog")
# A bleed, the actuator test and `lower` open the vent at most this far; a board that vents by
# itself opens it fully
VENTED_FRACTION = 0.5


@dataclass(slots=True)
class SafeLevelsState(StateNode):
    """The active level, and the time of the first level that is used up."""

    safe_level: SafeLevel = SafeLevel.NONE
    since_s: float = 0.0
    used_s: float = 0.0  # of HOLD_FLOW, when it was last left
    cleared_s: float = 0.0  # the moment of leaving


class SafeLevels:
    """The active safe level, and since when it acts."""

    def __init__(self, config: StatesConfig, memory: SafeLevelsState | None = None) -> None:
        self.memory = memory or SafeLevelsState()
        self._limit_s = {
            SafeLevel.HOLD_FLOW: config.hold_flow_max_s,
            SafeLevel.RAMP_DOWN: config.ramp_down_s,
            SafeLevel.PUMP_OFF: config.pump_off_max_s,
        }

    @property
    def safe_level(self) -> SafeLevel:
        """The active level."""
        return self.memory.safe_level

    def enter(self, safe_level: SafeLevel, now_s: float) -> None:
        """Enter a level if it is deeper than the present one.

        Parameters
        ----------
        safe_level : SafeLevel
            The level that the verdict requires.
        now_s : float
            Time of the tick. A hold of the mean flow that follows soon after another one lasts only
            what that left of its time.
        """
        memory = self.memory
        if safe_level > memory.safe_level:
            left_s = max(0.0, memory.used_s - (now_s - memory.cleared_s))
            used_s = left_s if safe_level == SafeLevel.HOLD_FLOW else 0.0
            memory.safe_level = safe_level
            memory.since_s = now_s - used_s

    def clear(self, now_s: float) -> None:
        """Leave the safe levels, but only from HOLD_FLOW: all deeper ones are latched."""
        memory = self.memory
        assert memory.safe_level == SafeLevel.HOLD_FLOW, memory.safe_level
        memory.used_s = self.age_s(now_s)
        memory.cleared_s = now_s
        memory.safe_level = SafeLevel.NONE

    def leave(self) -> None:
        """Leave the safe levels from any level, after an acknowledgement or by the resume rule."""
        self.memory.safe_level = SafeLevel.NONE
        self.memory.used_s = 0.0

    def age_s(self, now_s: float) -> float:
        """Time on the present level; on HOLD_FLOW including earlier time not yet recovered."""
        return now_s - self.memory.since_s

    def step(self, now_s: float) -> SafeLevel:
        """Return the present level, or the next one after a time-out."""
        limit_s = self._limit_s.get(self.safe_level)
        if limit_s is not None and self.age_s(now_s) > limit_s:
            self.enter(SafeLevel(self.safe_level + 1), now_s)
        return self.safe_level
