"""When a latched fault may clear without a person."""

import math
from collections import deque
from dataclasses import dataclass, field

from membrane_ctrl.config.schema import LimitsConfig, ResumeConfig
from membrane_ctrl.controller.observation import Observation
from membrane_ctrl.controller.safe_levels import DAY_S, VENTED_FRACTION, WATCHDOG_MASK, SafeLevels
from membrane_ctrl.controller.safety_rule import Rule
from membrane_ctrl.model.state_tree import StateNode
from membrane_ctrl.model.telemetry import SafeLevel


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
        self._config = config
        self._limits = limits
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

    def is_due(
        self, fault: Rule, levels: SafeLevels, observation: Observation, now_s: float
    ) -> bool:
        """Observe a tick of a fault.

        Sets `possible` (the fault may still clear automatically) and `clear_mask` (the board's
        latches to clear for that: the watchdog's, or none).

        Parameters
        ----------
        fault : Rule
            The rule that tripped.
        levels : SafeLevels
            How deep the fault has gone.
        observation : Observation
            Of this tick.
        now_s : float
            Time of the tick: the absence of the cause must last.

        Returns
        -------
        bool
            True once its cause has been absent for long enough.
        """
        self.memory.never |= _needs_a_person(levels, observation)
        listed = fault.may_resume and fault.name in self._config.faults
        self.possible = listed and not self.memory.never and self._has_resumes_left(now_s)
        self.clear_mask = observation.board_faults if self.possible else 0
        if not self.possible:
            self.memory.clear_since_s = math.nan
            return False
        silent = not observation.link_up or observation.reading_age_s > self._limits.stale_s
        gone = not (silent or self.clear_mask or fault.broken(observation, self._limits))
        if gone and observation.reading_age_s > 0.0:
            return False  # a single lost answer proves nothing
        return self._has_waited(gone, now_s)

    def _has_resumes_left(self, now_s: float) -> bool:
        """Whether the day's resumes are not used up."""
        while self.memory.resumed_s and now_s - self.memory.resumed_s[0] > DAY_S:
            self.memory.resumed_s.popleft()
        return len(self.memory.resumed_s) < self._config.most_per_day

    def _has_waited(self, gone: bool, now_s: float) -> bool:
        if not gone:
            self.memory.clear_since_s = math.nan
            return False
        if math.isnan(self.memory.clear_since_s):
            self.memory.clear_since_s = now_s
        return now_s - self.memory.clear_since_s >= self._config.wait_s


def _needs_a_person(levels: SafeLevels, observation: Observation) -> bool:
    """Whether only a person may clear the fault."""
    return (
        levels.safe_level == SafeLevel.VENT
        or bool(observation.board_faults & ~WATCHDOG_MASK)
        or observation.vent_fraction > VENTED_FRACTION
        or bool(observation.locked)
        or observation.open_interlocks != 0
        or bool(observation.foreign)
    )
