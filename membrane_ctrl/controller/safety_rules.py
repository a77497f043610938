"""What a tick shows, and what a rule of the safety table is. No I/O, no clock."""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass

from membrane_ctrl.config.schema import LimitsConfig
from membrane_ctrl.model.events import Fault
from membrane_ctrl.model.states import Rung, State

MOVING = frozenset({State.INFLATE, State.SETTLE, State.HOLD, State.MANUAL, State.TUNE})
HOLDING = frozenset({State.HOLD})
CONNECTED = MOVING | {State.CHECK}
ALWAYS = frozenset(State)
NOT_YET_FAULT = ALWAYS - {State.FAULT}


@dataclass(frozen=True, slots=True)
class Observation:
    """What one tick shows of the bench and of ourselves; NaN and None mean "not seen", never "fine"."""

    link_up: bool  # the device link is connected
    reading_age_s: float  # since the last answer of the device
    # since the device's sample counter and time last advanced; a repeated answer does not count
    advance_age_s: float
    displacement_um: float  # the laser's reading as it came, NaN if it was bad or absent
    displacement_valid: bool  # it is finite, new, of good quality, and no jump
    jumps: int  # readings in a row refused for a jump
    error_um: float  # setpoint minus reading; NaN outside the loop, and in a pause
    gauge_pressure_pa: float
    pump_mismatch: float  # largest of |command - read-back| that both of the last two commands agree on
    watchdog_tripped: bool
    board_faults: int
    lateness_ms: float
    dead_tasks: tuple[str, ...] = ()  # supervised tasks of the control process that ended
    tick_error: str = ""  # what a handler raised, if it did
    overdue: str = ""  # what the present state has waited for too long, if it has
    unfit: str = ""  # what the actuator test found, if anything
    same_s: float = 0.0  # since the valid readings have been equal to the last bit
    laser_lies: str = ""  # what laser, gauge and camera show, if the laser is wrong
    runs_on: str = ""  # the read-back of a pump that should have stopped
    inflow: str = ""  # how the mirror rises although the pump is commanded off
    locked: str = ""  # why a person has locked the mirror
    vent_fraction: float = math.nan  # the vent's read-back; NaN without one
    foreign: int = 0  # what another program changed: claim, watchdog (`roles.FOREIGN_...`)
    gauge_same_s: float = 0.0  # since the readings of a taut film's gauge have been equal to the last bit
    gauge_jumps: int = 0  # readings in a row that no film makes
    laser_gauge_apart: str = ""  # what laser and gauge show, if they contradict each other
    gas_excess: str = ""  # how much more gas the film takes than before, if no camera sees it stand still


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the table. `limit` and `remedy` are for people; `broken` decides.

    A tick in which `unseen` is true is left out of the window: a sensor that answers now and then, each time over its
    limit, must not be excused by the ticks between.
    """

    code: int
    name: str
    cause: str
    limit: str
    rung: Rung
    remedy: str
    broken: Callable[[Observation, LimitsConfig], bool]
    seen: Callable[[Observation], str] = lambda o: ""  # the observed value, for the operator
    seen_in: tuple[int, int] = (1, 1)  # ticks that must show the cause, of so many
    states: Collection[State] = MOVING
    # `resume.faults` may name it: a lost message or sensor, whose return is seen. All others need a person.
    may_resume: bool = False
    unseen: Callable[[Observation], bool] = lambda o: False

    @property
    def needed(self) -> int:
        """Ticks of the window that must show the cause."""
        return self.seen_in[0]

    @property
    def window(self) -> int:
        """Ticks that are looked back at."""
        return self.seen_in[1]

    @property
    def latching(self) -> bool:
        """Whether the fault stays until somebody acknowledges it."""
        return self.rung > Rung.HOLD_FLOW

    def fault(self, seen: str) -> Fault:
        """The event of a rule that has tripped, with the observed value in words."""
        return Fault(
            code=self.code,
            name=self.name,
            cause=self.cause,
            seen=seen,
            limit=self.limit,
            rung=self.rung.name.lower(),
            latching=self.latching,
            remedy=self.remedy,
        )
