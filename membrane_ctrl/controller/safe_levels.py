"""The safe levels: hold the last mean flow -> ramp down -> pump off -> vent.

A fault chooses the level to enter; each level times out into the next; only a clear observation on
the first level leads back up. The first level's time recovers only as fast as it is used, so a
cause present more than half of the time also times out.
"""

import math
from collections import deque
from dataclasses import dataclass, field

from firmware_iface.register_map import default_map
from membrane_ctrl.config.schema import LimitsConfig, ResumeConfig, StatesConfig
from membrane_ctrl.controller.safety import Observation, Rule
from membrane_ctrl.model.state_tree import StateNode
from membrane_ctrl.model.telemetry import SafeLevel

DAY_S = 86_400.0
WATCHDOG_MASK = default_map().fault_mask("watchdog")
# A bleed, the actuator test and `lower` open the vent at most this far; a board that vents by
# itself opens it fully
VENTED_FRACTION = 0.5


@dataclass(slots=True)
class SafeLevelsState(StateNode):
    """The level in force, and the time of the first level that is used up."""

    safe_level: SafeLevel = SafeLevel.NONE
    since_s: float = 0.0
    used_s: float = 0.0  # of HOLD_FLOW, when it was last left
    cleared_s: float = 0.0  # the moment of leaving


class SafeLevels:
    """The safe action in force, and since when."""

    def __init__(self, config: StatesConfig, memory: SafeLevelsState | None = None) -> None:
        self.memory = memory or SafeLevelsState()
        self._limit_s = {
            SafeLevel.HOLD_FLOW: config.hold_flow_max_s,
            SafeLevel.RAMP_DOWN: config.ramp_down_s,
            SafeLevel.PUMP_OFF: config.pump_off_max_s,
        }

    @property
    def safe_level(self) -> SafeLevel:
        """The level in force."""
        return self.memory.safe_level

    def enter(self, safe_level: SafeLevel, now_s: float) -> None:
        """Enter a level if it is deeper than the present one."""
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


@dataclass(slots=True)
class ResumeState(StateNode):
    """Earlier resumes, and what was observed of the present fault."""

    resumed_s: deque[float] = field(default_factory=deque)
    clear_since_s: float = math.nan
    never: bool = False  # only a person may clear the fault


class ResumeRule:
    """Whether a latched fault may clear automatically: only a listed one, its cause absent, a
    limited number a day.

    Never after a vent, a board latch other than the watchdog's, a board taken by another program, a
    person's lock, or an open interlock: any of these during the fault decides, whatever the first
    cause.
    """

    def __init__(
        self, config: ResumeConfig, limits: LimitsConfig, memory: ResumeState | None = None
    ) -> None:
        self._config, self._limits = config, limits
        self.memory = memory or ResumeState()
        self.possible = False
        self.clear_mask = 0

    def resumed(self, at_s: float) -> None:
        """Count a resume; those before this run have negative times."""
        self.memory.resumed_s.append(at_s)

    def forget(self) -> None:
        """Forget the observations of a fault that is over."""
        self.memory.clear_since_s = math.nan
        self.memory.never = False
        self.possible = False
        self.clear_mask = 0

    def due(self, fault: Rule, levels: SafeLevels, observation: Observation, now_s: float) -> bool:
        """Observe a tick of a fault; True once its cause has been absent for long enough.

        Sets `possible` (the fault may still clear automatically) and `clear_mask` (the board's
        latches to clear for
        that: the watchdog's, or none).
        """
        self.memory.never |= _decides(levels, observation)
        listed = fault.may_resume and fault.name in self._config.faults
        self.possible = listed and not self.memory.never and self._left(now_s)
        self.clear_mask = observation.board_faults if self.possible else 0
        if not self.possible:
            self.memory.clear_since_s = math.nan
            return False
        silent = not observation.link_up or observation.reading_age_s > self._limits.stale_s
        gone = not (silent or self.clear_mask or fault.broken(observation, self._limits))
        if gone and observation.reading_age_s > 0.0:
            return False  # a single lost answer proves nothing
        return self._waited(gone, now_s)

    def _left(self, now_s: float) -> bool:
        """Whether the day's resumes are not used up."""
        while self.memory.resumed_s and now_s - self.memory.resumed_s[0] > DAY_S:
            self.memory.resumed_s.popleft()
        return len(self.memory.resumed_s) < self._config.most_per_day

    def _waited(self, gone: bool, now_s: float) -> bool:
        if not gone:
            self.memory.clear_since_s = math.nan
            return False
        if math.isnan(self.memory.clear_since_s):
            self.memory.clear_since_s = now_s
        return now_s - self.memory.clear_since_s >= self._config.wait_s


def _decides(levels: SafeLevels, observation: Observation) -> bool:
    """Whether only a person may clear the fault."""
    return (
        levels.safe_level == SafeLevel.VENT
        or bool(observation.board_faults & ~WATCHDOG_MASK)
        or observation.vent_fraction > VENTED_FRACTION
        or bool(observation.locked)
        or observation.open_interlocks != 0
        or bool(observation.foreign)
    )
