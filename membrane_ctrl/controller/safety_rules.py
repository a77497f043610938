"""What the safety table sees in a tick, and what a rule is. No I/O, no clock."""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass

from membrane_ctrl.config.schema import LimitsConfig
from membrane_ctrl.model.events import Fault
from membrane_ctrl.model.states import SafeLevel, State

MOVING = frozenset({State.INFLATE, State.SETTLE, State.HOLD, State.MANUAL, State.TUNE})
HOLDING = frozenset({State.HOLD})
CONNECTED = MOVING | {State.CHECK}
ALWAYS = frozenset(State)
NOT_YET_FAULT = ALWAYS - {State.FAULT}


@dataclass(frozen=True, slots=True)
class Observation:
    """What one tick shows of the bench and of the program; NaN and None mean "not seen", never "fine"."""

    link_up: bool  # the device link is connected
    reading_age_s: float  # since the last answer of the device
    # since the device's sample counter and time last advanced; a repeated answer does not count
    advance_age_s: float
    displacement_um: float  # raw laser reading, NaN if bad or absent
    displacement_valid: bool  # finite, new, of good quality, not a jump
    jumps: int  # consecutive readings refused as jumps
    error_um: float  # setpoint minus reading; NaN outside the loop, and in a pause
    gauge_pressure_pa: float
    pump_mismatch: float  # |command - read-back|, the smaller of the last two commands'
    watchdog_tripped: bool
    board_faults: int
    lateness_ms: float
    dead_tasks: tuple[str, ...] = ()  # supervised tasks of the control process that ended
    tick_error: str = ""  # exception of a handler, if any
    overdue: str = ""  # what the present state has waited for too long, if anything
    unfit: str = ""  # what the actuator test found, if anything
    same_s: float = 0.0  # how long the valid readings have been bit-identical
    laser_lies: str = ""  # readings of laser, gauge and camera, if the laser is wrong
    runs_on: str = ""  # the read-back of a pump that should have stopped
    inflow: str = ""  # how the mirror rises although the pump is commanded off
    locked: str = ""  # why a person has locked the mirror
    vent_fraction: float = math.nan  # the vent's read-back; NaN without one
    foreign: int = 0  # changes by another program: claim, watchdog (`roles.FOREIGN_...`)
    gauge_same_s: float = 0.0  # how long a taut film's gauge readings have been bit-identical
    gauge_jumps: int = 0  # consecutive readings that no film can cause
    laser_gauge_apart: str = ""  # readings of laser and gauge, if they contradict each other
    optics_hold: bool = False  # the optics see the centre: the laser may be missing
    estimated_um: float = math.nan  # what the laser would read by them
    gas_excess: str = ""  # excess gas the film takes, unless a camera sees it stand still

    @property
    def depth_um(self) -> float:
        """The laser's reading, or what it would read while only the optics see the centre."""
        return self.estimated_um if self.optics_hold and math.isnan(self.displacement_um) else self.displacement_um


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the table. `limit` and `remedy` are for people; `broken` decides.

    The window skips ticks in which `unseen` is true: ticks without an answer must not excuse a sensor that exceeds
    its limit whenever it answers.
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
    # `resume.faults` may name it: a lost message or sensor whose return is visible. All others need a person.
    may_resume: bool = False
    unseen: Callable[[Observation], bool] = lambda o: False

    @property
    def needed(self) -> int:
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

    def fault(self, seen: str) -> Fault:
        """The event of a tripped rule, with the observed value in words."""
        return Fault(
            code=self.code,
            name=self.name,
            cause=self.cause,
            seen=seen,
            limit=self.limit,
            safe_level=self.safe_level.name.lower(),
            latching=self.latching,
            remedy=self.remedy,
        )
