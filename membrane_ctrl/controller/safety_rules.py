"""What a tick shows, and what a rule of the safety table is. No I/O, no clock."""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass

from membrane_ctrl.config.schema import LimitsConfig
from membrane_ctrl.model.states import Rung, State

MOVING = frozenset({State.INFLATE, State.SETTLE, State.HOLD, State.MANUAL, State.TUNE})
HOLDING = frozenset({State.HOLD})
CONNECTED = MOVING | {State.CHECK}
ALWAYS = frozenset(State)
NOT_YET_FAULT = ALWAYS - {State.FAULT}


@dataclass(frozen=True, slots=True)
class Observation:
    """What one tick shows of the bench and of ourselves; NaN and None mean "not seen", never "fine".

    Attributes
    ----------
    link_up : bool
        The device link is connected.
    reading_age_s : float
        Since the last answer of the device.
    advance_age_s : float
        Since the device's sample counter and time last advanced: an old answer repeated does not count.
    same_s : float
        Since the valid readings have been equal to the last bit.
    displacement_um : float
        The laser's reading as it came, NaN if it was bad or absent.
    displacement_valid : bool
        It is finite, of good quality, new, and not a jump that no film makes.
    jumps : int
        Readings in a row refused for a jump.
    error_um : float
        Setpoint minus reading; NaN outside the loop.
    gauge_pressure_pa : float
    pump_mismatch : float
        Largest of |command - read-back| that both of the last two commands agree on.
    watchdog_tripped : bool
    board_faults : int
    foreign : int
        What of the board's claim and watchdog is not as this run set it (`roles.FOREIGN_...`).
    lateness_ms : float
    dead_tasks : tuple of str
        Supervised tasks of the control process that ended.
    tick_error : str
        What a handler raised, if it did.
    overdue : str
        What the present state has waited for too long, if it has.
    unfit : str
        What the actuator test found, if anything.
    runs_on : str
        What the read-back says of a pump that was commanded off and ought to stand.
    inflow : str
        How the mirror rises although the pump is commanded off.
    locked : str
        Why a person has latched the mirror.
    vent_fraction : float
        The vent's read-back; NaN without one.
    laser_lies : str
        What laser, gauge and camera show, if it is the laser that does not fit.
    gauge_same_s : float
        Since the readings of a taut film's gauge have been equal to the last bit.
    gauge_jumps : int
        Readings in a row that no film makes.
    laser_gauge_apart : str
        What laser and gauge have seen, if both cannot be true.
    gas_excess : str
        How much more gas the film takes than it used to, if no camera sees that it stands still.
    """

    link_up: bool
    reading_age_s: float
    advance_age_s: float
    displacement_um: float
    displacement_valid: bool
    jumps: int
    error_um: float
    gauge_pressure_pa: float
    pump_mismatch: float
    watchdog_tripped: bool
    board_faults: int
    lateness_ms: float
    dead_tasks: tuple[str, ...] = ()
    tick_error: str = ""
    overdue: str = ""
    unfit: str = ""
    same_s: float = 0.0
    laser_lies: str = ""
    runs_on: str = ""
    inflow: str = ""
    locked: str = ""
    vent_fraction: float = math.nan
    foreign: int = 0
    gauge_same_s: float = 0.0
    gauge_jumps: int = 0
    laser_gauge_apart: str = ""
    gas_excess: str = ""


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the table. `limit` and `remedy` are for people; `broken` decides.

    A tick in which `unseen` is true shows nothing of the cause, neither way, and is left out of the window: a sensor
    that is only there now and then, over its limit each time, must not be forgiven for the ticks between.
    """

    code: int
    name: str
    cause: str
    limit: str
    rung: Rung
    remedy: str
    broken: Callable[[Observation, LimitsConfig], bool]
    seen: Callable[[Observation], str] = lambda o: ""  # the observed value, for the one line the operator reads
    seen_in: tuple[int, int] = (1, 1)  # ticks that must show the cause, of so many
    states: Collection[State] = MOVING
    # `resume.faults` may name it: the cause is a message or a sensor that was lost for a while, and whether it is
    # back is seen. All others need a person, who finds out why before gas flows again.
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
