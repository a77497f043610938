"""A row of the safety table: when it trips, which safe level it enters, and what people read."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

from membrane_ctrl.config.schema import LimitsConfig
from membrane_ctrl.controller.observation import Observation
from membrane_ctrl.controller.state_sets import MOVING
from membrane_ctrl.model.events import Fault
from membrane_ctrl.model.telemetry import SafeLevel, State


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the table. `limit` and `remedy` are for people; `broken` decides.

    The window skips ticks in which `unseen` is true: ticks without an answer must not excuse a
    sensor that exceeds its limit whenever it answers. `deepens` gives a level deeper than
    `safe_level` where what is observed demands it, and `enters` describes the level to people who
    read the table.
    """

    code: int
    name: str
    cause: str
    limit: str
    safe_level: SafeLevel
    remedy: str
    broken: Callable[[Observation, LimitsConfig], bool]
    seen: Callable[[Observation], str] = lambda o: ""  # the observed value, for the operator
    seen_in: tuple[int, int] = (1, 1)  # (m, n): m of n ticks must show the cause
    states: Collection[State] = MOVING
    # `resume.faults` may name it: a lost message or sensor whose return is visible. All others need
    # a person.
    may_resume: bool = False
    unseen: Callable[[Observation], bool] = lambda o: False
    deepens: Callable[[Observation], SafeLevel] = lambda o: SafeLevel.NONE
    enters: str = ""  # empty: always `safe_level`

    def find_safe_level(self, observation: Observation) -> SafeLevel:
        """The safe level that the rule enters if it trips on this observation."""
        return max(self.safe_level, self.deepens(observation))

    @property
    def needed_ticks(self) -> int:
        """Ticks of the window that must show the cause."""
        return self.seen_in[0]

    @property
    def window(self) -> int:
        """Length of the window in ticks."""
        return self.seen_in[1]

    @property
    def latching(self) -> bool:
        """Whether the fault stays until acknowledged."""
        return self.safe_level > SafeLevel.HOLD_FLOW

    def fault(self, seen: str, safe_level: SafeLevel) -> Fault:
        """Return the event of the tripped rule.

        Parameters
        ----------
        seen : str
            The observed value in words.
        safe_level : SafeLevel
            The level that it enters.
        """
        return Fault(
            code=self.code,
            name=self.name,
            cause=self.cause,
            seen=seen,
            limit=self.limit,
            safe_level=safe_level.name.lower(),
            latching=self.latching,
            remedy=self.remedy,
        )


def join_seen(*parts: str) -> str:
    """What was seen, in words; empty parts are left out."""
    return "; ".join(part for part in parts if part)
