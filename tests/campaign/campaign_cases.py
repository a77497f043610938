"""The faults of the campaign, and what must follow them: one row a fault."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from campaign_times import GAUGE_STUCK_S, HOLD_FLOW_S, STALE_S, TICK_S

from membrane_ctrl.controller.command import Kind
from membrane_ctrl.model.telemetry import SafeLevel, State

MOVING = frozenset({State.INFLATE, State.SETTLE, State.HOLD, State.MANUAL, State.TUNE})


_GUARD_S = 4.0  # an experiment's guard first tries to bring the mirror back


@dataclass(frozen=True)
class Reaction:
    """A lasting fault must have led to `safe_level` or deeper `within_s` after it began."""

    safe_level: SafeLevel
    within_s: float


@dataclass(frozen=True)
class Case:
    """One fault.

    Attributes
    ----------
    name : str
    wrong : dict
        Switches of `virtual_bench.Wrong`.
    causes : frozenset of str
        Rules that may name it; empty: harmless, nothing may trip.
    moving, holding, checking, always : Reaction or None
        What must follow in MOVING states, in `hold` alone, in `check`, in every state (in `fault`
        only what vents is still judged).
    for_s : float
        It goes away after this.
    every_s : float
        With `for_s`: it comes back with this period.
    leak_factor, door_pa : float
        It is of the mirror: the leak, the air pressure.
    power_cycle, raises : bool
        It is of the board, of the control code.
    laser_lies : bool
        The laser's reading is not the mirror's place.
    gauge_lies : bool
        The gauge's reading is not the pressure.
    believed : bool
        It may be taken for the truth after a while: nothing has to follow its first reaction.
    """

    name: str
    wrong: dict[str, float] = field(default_factory=dict)
    causes: frozenset[str] = frozenset()
    moving: Reaction | None = None
    holding: Reaction | None = None
    checking: Reaction | None = None
    always: Reaction | None = None
    for_s: float = math.inf
    every_s: float = math.inf
    leak_factor: float = 1.0
    door_pa: float = 0.0
    power_cycle: bool = False
    raises: bool = False
    laser_lies: bool = False
    gauge_lies: bool = False
    believed: bool = False

    @property
    def lasting(self) -> bool:
        """Whether it stays to the end, and with it what must follow."""
        return math.isinf(self.for_s) and not self.believed

    @property
    def hidden(self) -> bool:
        """Whether it shows only while the mirror is held: in `fault` it cannot be seen."""
        of_actuators = {"pump_share", "pump_stuck_fraction", "vent_stuck_fraction"}
        return (
            self.power_cycle
            or self.leak_factor != 1.0
            or self.door_pa != 0
            or bool(of_actuators & self.wrong.keys())
        )

    @property
    def lies(self) -> bool:
        """Whether the mirror is not where a sensor reads it."""
        return self.laser_lies or "camera_offset_um" in self.wrong

    @property
    def harmless(self) -> bool:
        """Nothing may trip."""
        return not self.causes

    def reaction(self, state: State) -> Reaction | None:
        """What must follow when it begins while the controller is in `state`."""
        if self.always is not None and (
            state != State.FAULT or self.always.safe_level == SafeLevel.VENT
        ):
            return self.always
        if self.holding is not None and state == State.HOLD:
            return self.holding
        if self.holding is not None and state == State.TUNE:
            return replace(self.holding, within_s=self.holding.within_s + _GUARD_S)
        return self.moving if state in MOVING else self.checking if state == State.CHECK else None


def _case(name: str, causes: str = "", **rest: object) -> Case:
    return Case(name, causes=frozenset(causes.split()), **rest)  # type: ignore[arg-type]


_LOST = "displacement_missing displacement_frozen overdue"
_SOON = (
    4 * TICK_S
)  # two ticks after a rule with a window of one, and the tick in which the fault begins
_TESTED = Reaction(SafeLevel.PUMP_OFF, 10.0)  # the actuator test, twice

CASES: tuple[Case, ...] = (
    _case("nothing"),
    _case(
        "no light", _LOST, wrong={"no_light": 1}, moving=Reaction(SafeLevel.HOLD_FLOW, 6 * TICK_S)
    ),
    _case("no light for 5 s", _LOST, wrong={"no_light": 1}, for_s=5.0),
    _case(
        "light a fifth of the time",
        _LOST,
        wrong={"no_light": 1},
        for_s=1.6,
        every_s=2.0,
        moving=Reaction(
            SafeLevel.RAMP_DOWN, 3.0 * HOLD_FLOW_S
        ),  # two thirds of the used budget recover
    ),
    _case("light comes and goes", _LOST, wrong={"no_light": 1}, for_s=1.0, every_s=2.0),
    _case(
        "laser 20 µm off",
        "",
        wrong={"laser_offset_um": -20},
        laser_lies=True,
        for_s=0.2,
        every_s=20.0,
    ),
    _case(
        "laser 200 µm off",
        f"{_LOST} displacement_jump following_error over_displacement under_displacement "
        "over_pressure actuator_test "
        "laser_gauge_apart",
        wrong={"laser_offset_um": -200},
        laser_lies=True,
        believed=True,
        moving=Reaction(SafeLevel.HOLD_FLOW, 8 * TICK_S),
    ),
    _case(
        "laser 600 µm too deep",
        "over_displacement",
        wrong={"laser_offset_um": 600},
        laser_lies=True,
        always=Reaction(SafeLevel.VENT, 5 * TICK_S),
    ),
    _case(
        "laser stuck",
        f"{_LOST} displacement_stuck actuator_test following_error",
        wrong={"laser_stuck": 1},
        laser_lies=True,
        moving=Reaction(SafeLevel.HOLD_FLOW, 5.0 + _SOON),
    ),
    _case(
        "board repeats its sample",
        f"{_LOST} pump_mismatch",
        wrong={"samples_frozen": 1},
        laser_lies=True,
        gauge_lies=True,
        moving=Reaction(SafeLevel.HOLD_FLOW, STALE_S + _SOON),
    ),
    _case(
        "gauge lost",
        "pressure_missing overdue",
        wrong={"gauge_lost": 1},
        gauge_lies=True,
        moving=Reaction(SafeLevel.RAMP_DOWN, 13 * TICK_S),
    ),
    _case(
        "gauge reads too much",
        "over_pressure",
        wrong={"gauge_offset_pa": 100},
        gauge_lies=True,
        always=Reaction(SafeLevel.VENT, 5 * TICK_S),
    ),
    _case(
        "gauge reads above the board's limit",
        "over_pressure board_fault",
        wrong={"gauge_offset_pa": 300},
        gauge_lies=True,
        always=Reaction(SafeLevel.VENT, 5 * TICK_S),
    ),
    _case(
        "gauge above the board's limit for one sample",
        "board_fault",
        wrong={"gauge_offset_pa": 300},
        for_s=TICK_S,
        gauge_lies=True,
        moving=Reaction(SafeLevel.PUMP_OFF, _SOON),
    ),
    _case(
        "gauge reads too little",
        "gauge_jump laser_gauge_apart",
        wrong={"gauge_offset_pa": -100},
        gauge_lies=True,
        moving=Reaction(SafeLevel.HOLD_FLOW, 8 * TICK_S),
        believed=True,
    ),
    _case(
        "gauge stuck",
        "gauge_stuck laser_gauge_apart",
        wrong={"gauge_stuck": 1},
        gauge_lies=True,
        moving=Reaction(SafeLevel.RAMP_DOWN, GAUGE_STUCK_S + _SOON),
    ),
    _case("barometer lost", wrong={"barometer_lost": 1}),
    _case("thermometer lost", wrong={"thermometer_lost": 1}),
    _case(
        "no answers",
        "device_silent no_answer overdue",
        wrong={"silent": 1},
        moving=Reaction(SafeLevel.PUMP_OFF, STALE_S + _SOON),
        checking=Reaction(SafeLevel.PUMP_OFF, STALE_S + _SOON),
    ),
    _case("no answers for 0.2 s", "no_answer", wrong={"silent": 1}, for_s=0.2),
    _case("every 15th answer lost", wrong={"lost_every": 15}),
    _case("every 7th answer lost", wrong={"lost_every": 7}),
    _case(
        "network cut",
        "link_lost",
        wrong={"unreachable": 1},
        moving=Reaction(SafeLevel.PUMP_OFF, _SOON),
        checking=Reaction(SafeLevel.PUMP_OFF, _SOON),
    ),
    _case("network cut for 0.1 s", "link_lost", wrong={"unreachable": 1}, for_s=0.1),
    _case(
        "network cut for 5 s",
        "link_lost watchdog_tripped board_fault overdue",
        wrong={"unreachable": 1},
        for_s=5.0,
    ),
    _case(
        "network comes and goes",
        "link_lost watchdog_tripped board_fault overdue",
        wrong={"unreachable": 1},
        for_s=1.5,
        every_s=3.0,
    ),
    _case("board loses its power", "link_lost actuator_test", power_cycle=True),
    _case(
        "pump's read-back stays at 1",
        "pump_mismatch pump_runs_on",
        wrong={"readback_fraction": 1.0},
        moving=Reaction(
            SafeLevel.PUMP_OFF, 8.0
        ),  # the command itself may be near 1 while the mirror rises
    ),
    _case(
        "pump gives nothing",
        "following_error actuator_test under_displacement",
        wrong={"pump_share": 0.0},
        holding=Reaction(SafeLevel.RAMP_DOWN, 40.0),
        checking=_TESTED,
    ),
    _case("pump gives 60 %", "", wrong={"pump_share": 0.6}),
    _case(
        "pump runs at full",
        "over_displacement over_pressure gas_comes_in following_error actuator_test",
        wrong={"pump_stuck_fraction": 1.0},
        moving=Reaction(SafeLevel.RAMP_DOWN, 25.0),
    ),
    _case(
        "pump stays at 0.5",
        "over_displacement over_pressure gas_comes_in following_error actuator_test",
        wrong={"pump_stuck_fraction": 0.5},
    ),
    _case(
        "vent stays open",
        f"{_LOST} following_error under_displacement displacement_jump actuator_test",
        wrong={"vent_stuck_fraction": 1.0},
        holding=Reaction(SafeLevel.RAMP_DOWN, 2.0),
    ),
    _case("vent stays shut", "actuator_test", wrong={"vent_stuck_fraction": 0.0}, checking=_TESTED),
    _case("process stopped for 0.2 s", "late", wrong={"stalled": 1}, for_s=0.2),
    _case(
        "process stopped for 2 s",
        "watchdog_tripped device_silent displacement_frozen late overdue actuator_test",
        wrong={"stalled": 1},
        for_s=2.0,
    ),
    _case("process stopped for ever", "-", wrong={"stalled": 1}),
    _case(
        "ticks 150 ms late",
        "late",
        wrong={"late_ms": 150},
        moving=Reaction(SafeLevel.RAMP_DOWN, 8 * TICK_S),
    ),
    _case(
        "task dead", "dead_task", wrong={"dead_task": 1}, always=Reaction(SafeLevel.PUMP_OFF, _SOON)
    ),
    _case(
        "control code raises", "tick_error", raises=True, always=Reaction(SafeLevel.PUMP_OFF, _SOON)
    ),
    _case("camera lost", wrong={"camera_lost": 1}),
    _case("camera sees 30 µm too much", wrong={"camera_offset_um": 30.0}),
    _case("leak ten times", "following_error under_displacement actuator_test", leak_factor=10.0),
    _case("door, 20 Pa", "actuator_test", door_pa=20.0),
    _case(
        "storm, 250 Pa at once",
        f"{_LOST} displacement_jump following_error under_displacement",
        door_pa=250.0,
    ),
    _case(
        "laser and gauge lost",
        f"{_LOST} pressure_missing",
        wrong={"no_light": 1, "gauge_lost": 1},
        gauge_lies=True,
        moving=Reaction(SafeLevel.RAMP_DOWN, 13 * TICK_S),
    ),
    _case(
        "laser lost while the pump runs at full",
        f"{_LOST} over_pressure over_displacement following_error actuator_test gas_comes_in",
        wrong={"no_light": 1, "pump_stuck_fraction": 1.0},
        moving=Reaction(SafeLevel.HOLD_FLOW, 6 * TICK_S),
    ),
    _case(
        "process stopped while the laser is lost",
        f"{_LOST} watchdog_tripped device_silent late",
        wrong={"no_light": 1, "stalled": 1},
        for_s=1.0,
    ),
    _case(
        "no answers and late",
        f"{_LOST} device_silent no_answer late",
        wrong={"silent": 1, "late_ms": 150},
        moving=Reaction(SafeLevel.RAMP_DOWN, STALE_S + _SOON),
    ),
)


@dataclass(frozen=True)
class Situation:
    """State of the controller when something goes wrong, and how it got there.

    Attributes
    ----------
    name : str
    state : State
        The fault sets in a while after it was reached.
    asks : tuple of (str, float)
        Commands in `hold` that lead to it, with their values.
    again_s : float
        The commands are asked again and again with this period.
    held : bool
        An undisturbed mirror is at `target_um` in the end.
    """

    name: str
    state: State
    asks: tuple[tuple[Kind, float], ...] = ()
    again_s: float = math.inf
    held: bool = False
    target_um: float = 0.0


SITUATIONS: tuple[Situation, ...] = (
    Situation("standby", State.STANDBY),
    Situation("check", State.CHECK, held=True),
    Situation("inflate", State.INFLATE, held=True),
    Situation("settle", State.SETTLE, held=True),
    Situation("hold", State.HOLD, held=True),
    Situation("paused", State.HOLD, (("pause", math.nan),), held=True),
    # as `calibrate --live` does: from one pressure to the next
    Situation("stepped", State.HOLD, (("setpoint", -10.0), ("setpoint", 10.0)), again_s=12.0),
    Situation("manual", State.MANUAL, (("manual", math.nan),)),
    Situation("tune", State.TUNE, (("tune", math.nan),)),
    Situation("lower", State.LOWER, (("vent", math.nan),)),
    Situation("fault", State.FAULT),
)
