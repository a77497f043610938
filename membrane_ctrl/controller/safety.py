"""The safety table: a tick's observation in, a verdict out. No I/O, no clock.

Each rule names a cause, how many of the last ticks must show it (N of M), the limit, the rung among the
safe actions where it enters, and whether it latches. Every rule is judged on every tick in the states where it
applies. Of rules that trip together the one that enters deepest wins; the first cause of a fault is what the
operator is told. `docs/faults.md` is made from this table.
"""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass

from firmware_iface.roles import FOREIGN_CLAIM, FOREIGN_PERIOD
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


@dataclass(frozen=True, slots=True)
class Verdict:
    """The rule that tripped (None: safe) and the observed value in words."""

    rule: Rule | None
    seen: str = ""


# Two looks at a limit that must never be passed: one bit error may not vent a mirror that takes two hours to
# fill, and two ticks are 40 ms, in which the pump moves the film by 0.2 um.
_TWICE = (2, 3)
# The pump needs its lag (0.15 s) and the dead time of a tick or two to follow a command.
# What the loop's own noise moves the command by hides a constant difference in some ticks.
_FOLLOWED = (40, 50)
# The loop holds its mean flow over any tick without a reading; one repeated sample of a busy device is no fault yet.
_A_FEW = (3, 3)

TABLE: tuple[Rule, ...] = (
    Rule(
        code=20,
        name="over_pressure",
        cause="gauge pressure above its limit",
        seen_in=_TWICE,
        limit="limits.gauge_pressure_max_pa",
        rung=Rung.VENT,
        states=ALWAYS,
        remedy="find what over-filled the mirror before it is inflated again",
        broken=lambda o, c: o.gauge_pressure_pa > c.gauge_pressure_max_pa,
        unseen=lambda o: math.isnan(o.gauge_pressure_pa),
    ),
    Rule(
        code=21,
        name="over_displacement",
        cause="the bowl is deeper than its limit",
        seen_in=_TWICE,
        limit="limits.displacement_max_um",
        rung=Rung.VENT,
        states=ALWAYS,
        remedy="check the laser against a ruler, then the setpoint and the limits",
        broken=lambda o, c: o.displacement_um > c.displacement_max_um,
        unseen=lambda o: math.isnan(o.displacement_um),
    ),
    Rule(
        code=35,
        name="pump_runs_on",
        cause="the pump does not stop when it is commanded off",
        limit="states.lower_timeout_s",
        rung=Rung.VENT,
        states=ALWAYS,
        remedy="cut the pump's power or shut its gas; then check its drive and wiring",
        broken=lambda o, c: bool(o.runs_on),
    ),
    Rule(
        code=36,
        name="gas_comes_in",
        cause="the mirror rises although the pump is commanded off",
        limit="30 um in 20 s beyond what the weather explains",
        rung=Rung.VENT,
        states=ALWAYS - MOVING,
        remedy="cut the pump's power or shut its gas: its read-back may be wrong, or gas comes another way",
        broken=lambda o, c: bool(o.inflow),
    ),
    Rule(
        code=51,
        name="locked",
        cause="a person has latched the mirror",
        limit="ctl ack",
        rung=Rung.PUMP_OFF,
        states=CONNECTED | {State.FAULT},
        remedy="see with whoever latched it that the mirror may move",
        broken=lambda o, c: bool(o.locked),
    ),
    Rule(
        code=50,
        name="tick_error",
        cause="the control code raised an error",
        limit="none may happen",
        rung=Rung.PUMP_OFF,
        states=NOT_YET_FAULT,
        remedy="report it with the run folder",
        broken=lambda o, c: bool(o.tick_error),
    ),
    Rule(
        code=41,
        name="dead_task",
        cause="a task of the control process ended",
        limit="none may end",
        rung=Rung.PUMP_OFF,
        states=NOT_YET_FAULT,
        remedy="report it with the run folder",
        broken=lambda o, c: bool(o.dead_tasks),
    ),
    Rule(
        code=30,
        name="link_lost",
        cause="the link to the pump board is down",
        limit="must be up",
        rung=Rung.PUMP_OFF,
        states=CONNECTED,
        remedy="check cable, power and address; the board's watchdog has stopped the pump",
        may_resume=True,
        broken=lambda o, c: not o.link_up,
    ),
    Rule(
        code=31,
        name="device_silent",
        cause="the device link is up, but no answer came in time",
        limit="limits.stale_s",
        rung=Rung.PUMP_OFF,
        states=CONNECTED,
        remedy="check the board; its watchdog has stopped the pump",
        may_resume=True,
        broken=lambda o, c: o.reading_age_s > c.stale_s,
    ),
    Rule(
        code=37,
        name="board_taken",
        cause="the board's claim or watchdog is no longer as this run set it",
        limit="as set by this run",
        rung=Rung.PUMP_OFF,
        states=NOT_YET_FAULT,
        remedy="find the other program that controls the board, and stop one of the two",
        broken=lambda o, c: o.foreign != 0,
    ),
    Rule(
        code=32,
        name="watchdog_tripped",
        cause="the board's watchdog stopped the pump",
        limit="must not trip",
        rung=Rung.PUMP_OFF,
        states=CONNECTED,
        remedy="look at the lateness in the recording; the machine may be overloaded",
        may_resume=True,
        broken=lambda o, c: o.watchdog_tripped,
    ),
    Rule(
        code=33,
        name="board_fault",
        cause="the board has latched a fault of its own",
        limit="must be 0",
        rung=Rung.PUMP_OFF,
        states=CONNECTED,
        remedy="read the board's fault bits (docs/registers.md)",
        broken=lambda o, c: o.board_faults != 0,
    ),
    Rule(
        code=34,
        name="pump_mismatch",
        cause="the pump's read-back does not follow its command",
        seen_in=_FOLLOWED,
        limit="0.05 of full scale",
        rung=Rung.PUMP_OFF,
        remedy="check the pump's drive and its limits on the board",
        broken=lambda o, c: o.pump_mismatch > 0.05,
    ),
    Rule(
        code=12,
        name="displacement_frozen",
        cause="the device answers, but its samples do not advance",
        limit="limits.stale_s",
        rung=Rung.HOLD_FLOW,
        remedy="restart the sensor",
        may_resume=True,
        broken=lambda o, c: o.advance_age_s > c.stale_s,
    ),
    Rule(
        code=14,
        name="laser_implausible",
        cause="camera and gauge agree that the laser does not show where the mirror is",
        limit="shape.disagreement_max_um",
        rung=Rung.HOLD_FLOW,
        states=HOLDING,
        remedy="look for a knocked laser mount; then take a new reference with `ctl shape off` and `ctl shape on`",
        broken=lambda o, c: bool(o.laser_lies),
    ),
    Rule(
        code=18,
        name="laser_gauge_apart",
        cause="laser and gauge do not show the same film",
        limit="limits.laser_gauge_apart_max_um, limits.laser_gauge_drift_max_um",
        rung=Rung.RAMP_DOWN,
        states=CONNECTED,
        remedy="see which of them is wrong: laser mount, gauge hose, units; for another film set [optics.mirror] "
        "sag_mm and pressure_pa",
        broken=lambda o, c: bool(o.laser_gauge_apart),
    ),
    Rule(
        code=16,
        name="gauge_stuck",
        cause="the gauge repeats one value to the last bit",
        limit="limits.gauge_stuck_s",
        rung=Rung.RAMP_DOWN,
        remedy="restart the gauge; if it filters its noise below its own resolution raise limits.gauge_stuck_s",
        broken=lambda o, c: o.gauge_same_s > c.gauge_stuck_s,
        unseen=lambda o: math.isnan(o.gauge_pressure_pa),
    ),
    Rule(
        code=19,
        name="gas_excess",
        cause="the film takes far more gas than it used to, and no camera sees it stand still",
        limit="limits.leak_growth_max",
        rung=Rung.RAMP_DOWN,
        states=HOLDING,
        remedy="look for an opening seam, then for a laser that creeps: compare it with a ruler",
        broken=lambda o, c: bool(o.gas_excess),
    ),
    Rule(
        code=17,
        name="gauge_jump",
        cause="the gauge reading jumped further than a film can",
        seen_in=(5, 10),
        limit="limits.gauge_step_max_pa",
        rung=Rung.HOLD_FLOW,
        remedy="look at the gauge's hose and plug",
        broken=lambda o, c: o.gauge_jumps > 0,
    ),
    Rule(
        code=15,
        name="displacement_stuck",
        cause="the laser repeats one value to the last bit",
        limit="limits.stuck_s",
        rung=Rung.HOLD_FLOW,
        remedy="restart the sensor; with coarse steps and a calm mirror raise limits.stuck_s",
        broken=lambda o, c: o.displacement_valid and o.same_s > c.stuck_s,
    ),
    Rule(
        code=13,
        name="displacement_jump",
        cause="the laser reading jumped further than a film can",
        seen_in=(5, 10),
        limit="limits.step_max_um",
        rung=Rung.HOLD_FLOW,
        remedy="look for something in the beam or a bumped laser",
        may_resume=True,
        broken=lambda o, c: o.jumps > 0,
    ),
    Rule(
        code=10,
        name="displacement_missing",
        cause="no valid laser reading",
        seen_in=_A_FEW,
        limit="3 ticks in a row",
        rung=Rung.HOLD_FLOW,
        remedy="check the laser's aim and its error code",
        may_resume=True,
        broken=lambda o, c: not o.displacement_valid,
    ),
    Rule(
        code=24,
        name="pressure_missing",
        cause="no gauge pressure",
        seen_in=(10, 10),
        limit="every tick",
        rung=Rung.RAMP_DOWN,
        remedy="check the pressure sensor: without it over-pressure is not seen",
        may_resume=True,
        broken=lambda o, c: not math.isfinite(o.gauge_pressure_pa) and o.reading_age_s == 0,
        unseen=lambda o: o.reading_age_s > 0,
    ),
    Rule(
        code=22,
        name="under_displacement",
        cause="the bowl is shallower than its limit",
        seen_in=_TWICE,
        limit="limits.displacement_min_um",
        rung=Rung.RAMP_DOWN,
        states=HOLDING,
        remedy="look for a leak or a laser that was moved",
        broken=lambda o, c: o.displacement_um < c.displacement_min_um,
        unseen=lambda o: math.isnan(o.displacement_um),
    ),
    Rule(
        code=23,
        name="following_error",
        cause="the mirror does not follow its setpoint",
        seen_in=(100, 100),
        limit="limits.following_error_max_um",
        rung=Rung.RAMP_DOWN,
        states=HOLDING,
        remedy="look for a leak, a stuck pump or a mirror that is too tight",
        broken=lambda o, c: abs(o.error_um) > c.following_error_max_um,
        unseen=lambda o: math.isnan(o.error_um),
    ),
    Rule(
        code=25,
        name="overdue",
        cause="a state took too long",
        limit="[states] time-outs",
        rung=Rung.RAMP_DOWN,
        states=CONNECTED,
        remedy="see what it waited for; a fill from flat needs states.inflate_timeout_s of hours",
        broken=lambda o, c: bool(o.overdue),
    ),
    Rule(
        code=26,
        name="actuator_test",
        cause="the film does not answer to pump or vent",
        limit="pump_obeys.py",
        rung=Rung.PUMP_OFF,
        states={State.CHECK},
        remedy="check hoses, valve and pump, and where the laser points",
        broken=lambda o, c: bool(o.unfit),
    ),
    Rule(
        code=40,
        name="late",
        cause="ticks start too late to be a control loop",
        seen_in=(5, 10),
        limit="limits.lateness_max_ms",
        rung=Rung.RAMP_DOWN,
        remedy="take other work off this machine",
        may_resume=True,
        broken=lambda o, c: o.lateness_ms > c.lateness_max_ms,
    ),
)


class SafetyTable:
    """Judges observations by the table; remembers only the last M ticks that showed something of each rule."""

    def __init__(self, limits: LimitsConfig, table: tuple[Rule, ...] = TABLE) -> None:
        self._limits = limits
        self._table = table
        self._history = [0] * len(table)

    def judge(self, state: State, observation: Observation) -> Verdict:
        """The tripped rule that enters deepest, of equal ones the first. All are looked at: no history has a hole.

        Not simply the first: a lost laser, which is held on the mean flow, must not hide a lost pressure sensor.
        """
        tripped: Rule | None = None
        for index, rule in enumerate(self._table):
            if state not in rule.states:
                self._history[index] = 0
                continue
            broken = rule.broken(observation, self._limits)
            if not broken and not self._history[index]:
                continue  # nearly always
            if rule.unseen(observation):
                continue
            history = ((self._history[index] << 1) | broken) & ((1 << rule.window) - 1)
            self._history[index] = history
            if history.bit_count() >= rule.needed and (tripped is None or rule.rung > tripped.rung):
                tripped = rule
        return Verdict(tripped, _seen(tripped, observation) if tripped else "")


_FOREIGN = {FOREIGN_CLAIM: "another claim is in force", FOREIGN_PERIOD: "another watchdog period is in force"}


def _seen(rule: Rule, observation: Observation) -> str:
    """The observed value behind a trip, for the one line the operator reads."""
    match rule.name:
        case "over_pressure" | "pressure_missing":
            return f"{observation.gauge_pressure_pa:.1f} Pa"
        case "over_displacement" | "under_displacement":
            return f"{observation.displacement_um:.1f} um"
        case "following_error":
            return f"{observation.error_um:.1f} um"
        case "device_silent":
            return f"{observation.reading_age_s:.2f} s"
        case "laser_implausible":
            return observation.laser_lies
        case "laser_gauge_apart":
            return observation.laser_gauge_apart
        case "gas_excess":
            return observation.gas_excess
        case "gauge_stuck":
            return f"{observation.gauge_pressure_pa:.1f} Pa for {observation.gauge_same_s:.0f} s"
        case "gauge_jump":
            return f"{observation.gauge_pressure_pa:.1f} Pa"
        case "displacement_stuck":
            return f"{observation.same_s:.1f} s"
        case "displacement_frozen":
            return f"{observation.advance_age_s:.2f} s"
        case "late":
            return f"{observation.lateness_ms:.0f} ms"
        case "board_fault":
            return f"bits {observation.board_faults:#x}"
        case "pump_runs_on":
            return observation.runs_on
        case "gas_comes_in":
            return observation.inflow
        case "locked":
            return observation.locked
        case "board_taken":
            return " and ".join(words for bit, words in _FOREIGN.items() if observation.foreign & bit)
        case "dead_task":
            return ", ".join(observation.dead_tasks)
        case "tick_error":
            return observation.tick_error
        case "overdue":
            return observation.overdue
        case "actuator_test":
            return observation.unfit
        case _:
            return ""
