"""The safety table: a tick's observation in, a verdict out. No I/O, no clock.

Each rule names a cause, how many of the last ticks must show it (N of M), the limit, the rung of the ladder of
safe actions where it enters, and whether it latches. Every rule is judged on every tick in the states where it
applies. Of rules that trip together the one that enters deepest wins; the first cause of a fault is what the
operator is told. `docs/faults.md` is made from this table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass

from membrane_ctrl.config import LimitsConfig
from membrane_ctrl.names import Rung, State

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
    lateness_ms : float
    dead_tasks : tuple of str
        Supervised tasks of the control process that ended.
    tick_error : str
        What a handler raised, if it did.
    overdue : str
        What the present state has waited for too long, if it has.
    unfit : str
        What the actuator test found, if anything.
    laser_lies : str
        What the three witnesses of the sag have seen, if it is the laser that does not fit.
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


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the table. `limit` and `remedy` are for people; `broken` decides.

    A tick in which `unseen` is true shows nothing of the cause, neither way, and is left out of the window: a sensor
    that is only there now and then, over its limit each time, must not be forgiven for the ticks between.
    """

    code: int
    name: str
    cause: str
    needed: int
    window: int
    limit: str
    rung: Rung
    latching: bool
    states: Collection[State]
    remedy: str
    broken: Callable[[Observation, LimitsConfig], bool]
    unseen: Callable[[Observation], bool] = lambda o: False


@dataclass(frozen=True, slots=True)
class Verdict:
    """The rule that tripped (None: safe) and the observed value in words."""

    rule: Rule | None
    seen: str = ""


# Two looks at a limit that must never be passed: one bit error may not vent a mirror that takes two hours to
# fill, and two ticks are 40 ms, in which the pump moves the film by 0.2 um.
_TWICE = (2, 3)
# The pump needs its lag (0.15 s) and the dead time of a tick or two to follow a command.
_FOLLOWED = (50, 50)
# The loop holds its mean flow over any tick without a reading; one repeated sample of a busy device is no fault yet.
_A_FEW = (3, 3)

TABLE: tuple[Rule, ...] = (
    Rule(
        20,
        "over_pressure",
        "gauge pressure above its limit",
        *_TWICE,
        "limits.gauge_pressure_max_pa",
        Rung.VENT,
        True,
        ALWAYS,
        "find what over-filled the mirror before it is inflated again",
        lambda o, c: o.gauge_pressure_pa > c.gauge_pressure_max_pa,
        lambda o: math.isnan(o.gauge_pressure_pa),
    ),
    Rule(
        21,
        "over_displacement",
        "the bowl is deeper than its limit",
        *_TWICE,
        "limits.displacement_max_um",
        Rung.VENT,
        True,
        ALWAYS,
        "check the laser against a ruler, then the setpoint and the limits",
        lambda o, c: o.displacement_um > c.displacement_max_um,
        lambda o: math.isnan(o.displacement_um),
    ),
    Rule(
        50,
        "tick_error",
        "the control code raised an error",
        1,
        1,
        "none may happen",
        Rung.PUMP_OFF,
        True,
        NOT_YET_FAULT,
        "report it with the run folder",
        lambda o, c: bool(o.tick_error),
    ),
    Rule(
        41,
        "dead_task",
        "a task of the control process ended",
        1,
        1,
        "none may end",
        Rung.PUMP_OFF,
        True,
        NOT_YET_FAULT,
        "report it with the run folder",
        lambda o, c: bool(o.dead_tasks),
    ),
    Rule(
        30,
        "link_lost",
        "the link to the pump board is down",
        1,
        1,
        "must be up",
        Rung.PUMP_OFF,
        True,
        CONNECTED,
        "check cable, power and address; the board's watchdog has stopped the pump",
        lambda o, c: not o.link_up,
    ),
    Rule(
        31,
        "device_silent",
        "the device link is up, but no answer came in time",
        1,
        1,
        "limits.stale_s",
        Rung.PUMP_OFF,
        True,
        CONNECTED,
        "check the board; its watchdog has stopped the pump",
        lambda o, c: o.reading_age_s > c.stale_s,
    ),
    Rule(
        32,
        "watchdog_tripped",
        "the board's watchdog stopped the pump",
        1,
        1,
        "must not trip",
        Rung.PUMP_OFF,
        True,
        MOVING,
        "look at the lateness in the recording; the machine may be overloaded",
        lambda o, c: o.watchdog_tripped,
    ),
    Rule(
        33,
        "board_fault",
        "the board has latched a fault of its own",
        1,
        1,
        "must be 0",
        Rung.PUMP_OFF,
        True,
        MOVING,
        "read the board's fault bits (docs/registers.md)",
        lambda o, c: o.board_faults != 0,
    ),
    Rule(
        34,
        "pump_mismatch",
        "the pump's read-back does not follow its command",
        *_FOLLOWED,
        "0.05 of full scale",
        Rung.PUMP_OFF,
        True,
        MOVING,
        "check the pump's drive and its limits on the board",
        lambda o, c: o.pump_mismatch > 0.05,
    ),
    Rule(
        12,
        "displacement_frozen",
        "the device answers, but its samples do not advance",
        1,
        1,
        "limits.stale_s",
        Rung.HOLD_FLOW,
        False,
        MOVING,
        "restart the sensor",
        lambda o, c: o.advance_age_s > c.stale_s,
    ),
    Rule(
        14,
        "laser_implausible",
        "camera and gauge agree that the laser does not show where the mirror is",
        1,
        1,
        "shape.disagreement_max_um",
        Rung.HOLD_FLOW,
        False,
        HOLDING,
        "look for a knocked laser mount; then take a new reference with `ctl shape off` and `ctl shape on`",
        lambda o, c: bool(o.laser_lies),
    ),
    Rule(
        15,
        "displacement_stuck",
        "the laser repeats one value to the last bit",
        1,
        1,
        "limits.stuck_s",
        Rung.HOLD_FLOW,
        False,
        MOVING,
        "restart the sensor; with coarse steps and a calm mirror raise limits.stuck_s",
        lambda o, c: o.displacement_valid and o.same_s > c.stuck_s,
    ),
    Rule(
        13,
        "displacement_jump",
        "the laser reading jumped further than a film can",
        5,
        10,
        "limits.step_max_um",
        Rung.HOLD_FLOW,
        False,
        MOVING,
        "look for something in the beam or a bumped laser",
        lambda o, c: o.jumps > 0,
    ),
    Rule(
        10,
        "displacement_missing",
        "no valid laser reading",
        *_A_FEW,
        "3 ticks in a row",
        Rung.HOLD_FLOW,
        False,
        MOVING,
        "check the laser's aim and its error code",
        lambda o, c: not o.displacement_valid,
    ),
    Rule(
        24,
        "pressure_missing",
        "no gauge pressure",
        10,
        10,
        "every tick",
        Rung.RAMP_DOWN,
        True,
        MOVING,
        "check the pressure sensor: without it over-pressure is not seen",
        lambda o, c: not math.isfinite(o.gauge_pressure_pa) and o.reading_age_s == 0,
        lambda o: o.reading_age_s > 0,
    ),
    Rule(
        22,
        "under_displacement",
        "the bowl is shallower than its limit",
        *_TWICE,
        "limits.displacement_min_um",
        Rung.RAMP_DOWN,
        True,
        HOLDING,
        "look for a leak or a laser that was moved",
        lambda o, c: o.displacement_um < c.displacement_min_um,
        lambda o: math.isnan(o.displacement_um),
    ),
    Rule(
        23,
        "following_error",
        "the mirror does not follow its setpoint",
        100,
        100,
        "limits.following_error_max_um",
        Rung.RAMP_DOWN,
        True,
        HOLDING,
        "look for a leak, a stuck pump or a mirror that is too tight",
        lambda o, c: abs(o.error_um) > c.following_error_max_um,
        lambda o: math.isnan(o.error_um),
    ),
    Rule(
        25,
        "overdue",
        "a state took too long",
        1,
        1,
        "[states] time-outs",
        Rung.RAMP_DOWN,
        True,
        CONNECTED,
        "see what it waited for; a fill from flat needs states.inflate_timeout_s of hours",
        lambda o, c: bool(o.overdue),
    ),
    Rule(
        26,
        "actuator_test",
        "the film does not answer to pump or vent",
        1,
        1,
        "actuator_test.py",
        Rung.PUMP_OFF,
        True,
        {State.CHECK},
        "check hoses, valve and pump, and where the laser points",
        lambda o, c: bool(o.unfit),
    ),
    Rule(
        40,
        "late",
        "ticks start too late to be a control loop",
        5,
        10,
        "limits.lateness_max_ms",
        Rung.RAMP_DOWN,
        True,
        MOVING,
        "take other work off this machine",
        lambda o, c: o.lateness_ms > c.lateness_max_ms,
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
        case "displacement_stuck":
            return f"{observation.same_s:.1f} s"
        case "displacement_frozen":
            return f"{observation.advance_age_s:.2f} s"
        case "late":
            return f"{observation.lateness_ms:.0f} ms"
        case "board_fault":
            return f"bits {observation.board_faults:#x}"
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
