"""May a latched fault clear by itself? Only listed ones, only when their cause has stayed away, only so often."""

from __future__ import annotations

import math
from collections import deque

from membrane_ctrl.config import ResumeConfig
from membrane_ctrl.names import Rung
from membrane_ctrl.safety import Rule

_DAY_S = 86_400.0


class ResumeRule:
    """Counts the resumes of the last day and how long the present cause has been away."""

    def __init__(self, config: ResumeConfig) -> None:
        self._config = config
        self._resumed_s: deque[float] = deque()
        self._clear_since_s = math.nan

    def possible(self, fault: Rule, rung: Rung, now_s: float) -> bool:
        """The fault is on the list, the mirror was not vented, and the day's number is not used up."""
        while self._resumed_s and now_s - self._resumed_s[0] > _DAY_S:
            self._resumed_s.popleft()
        return (
            fault.name in self._config.faults
            and rung < Rung.VENT
            and len(self._resumed_s) < self._config.most_per_day
        )

    def due(self, cause_gone: bool, now_s: float) -> bool:
        """The cause has stayed away for long enough; True counts as a resume."""
        if not cause_gone:
            self._clear_since_s = math.nan
            return False
        if math.isnan(self._clear_since_s):
            self._clear_since_s = now_s
        if now_s - self._clear_since_s < self._config.wait_s:
            return False
        self._clear_since_s = math.nan
        self._resumed_s.append(now_s)
        return True
