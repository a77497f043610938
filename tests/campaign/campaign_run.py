"""One run of the campaign: bring the controller to a state, let something go wrong, monitor to the
end.

The end: 45 s after the fault, in which every safe level has had its time, somebody asks for a stop.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from campaign_cases import Case, Situation
from campaign_times import (
    DISPLACEMENT_MAX_UM,
    DISPLACEMENT_MIN_UM,
    FOLLOWING_ERROR_MAX_UM,
    GAUGE_MARGIN_PA,
    GAUGE_STUCK_S,
    HOLD_FLOW_S,
    PUMP_OFF_S,
    RAMP_S,
    RATE_HZ,
    RESUME_WAIT_S,
    RESUMES_A_DAY,
    STALE_S,
    TICK_S,
    WATCHDOG_S,
)
from campaign_watch import Watch
from campaign_world import WatchedPlant, World, world_of

from membrane_ctrl.config.schema import (
    Config,
    LimitsConfig,
    LoopConfig,
    ResumeConfig,
    ShapeConfig,
    StatesConfig,
)
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.controller import state_handlers
from membrane_ctrl.controller.command import Command, Kind
from membrane_ctrl.controller.tick_context import TickContext
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.telemetry import SafeLevel, State
from membrane_ctrl.sim.bench_events import AmbientChange, LeakChange
from membrane_ctrl.sim.virtual_bench import VirtualBench, Wrong

AFTERMATH_S = 45.0
THE_STOP_S = 12.0
GIVE_UP_S = 120.0
_ROUNDING_S = 1e-6  # one tick is one tick, wherever on the clock it lies
PAUSE_S, MANUAL_S, MANUAL_RANGE_UM = 20.0, 60.0, 20.0
# what a person might list; a fault that vented may never resume
RESUMABLE = (
    "link_lost",
    "device_silent",
    "watchdog_tripped",
    "board_fault",
    "displacement_missing",
    "displacement_frozen",
    "pressure_missing",
    "late",
    "over_pressure",
    "over_displacement",
    "following_error",
    "overdue",
)


@dataclass(frozen=True)
class Result:
    """Result of one run; `violations` is empty when every invariant held, `tripped` names rules."""

    case: str
    situation: str
    seed: int
    cause: str
    safe_level: SafeLevel
    reaction_s: float
    violations: tuple[str, ...]
    tripped: tuple[str, ...] = ()


class Injection:
    """Begins the fault at its time, and ends it."""

    def __init__(self, case: Case, bench: VirtualBench) -> None:
        self._case, self._bench = case, bench
        self._on = False
        self.started_s = self.last_on_s = math.nan

    def begin(self, now_s: float) -> None:
        """It sets in."""
        self.started_s = now_s
        if self._case.power_cycle:
            self._bench.power_cycle()

    def update(self, now_s: float) -> None:
        """Set the switches as they are now."""
        if math.isnan(self.started_s):
            return
        case, age_s = self._case, now_s - self.started_s
        if math.isinf(case.for_s):
            on = True
        elif math.isinf(case.every_s):
            on = age_s < case.for_s - _ROUNDING_S
        else:
            on = age_s % case.every_s < case.for_s - _ROUNDING_S
        if on:
            self.last_on_s = now_s
        if on != self._on:
            self._on = on
            source = case.wrong if on else {name: getattr(Wrong(), name) for name in case.wrong}
            for name, value in source.items():
                setattr(self._bench.wrong, name, value)


def run_case(case: Case, at: Situation, seed: int) -> Result:
    """Run one cell of the matrix; equal arguments give equal results."""
    rng = np.random.default_rng([seed, *at.name.encode(), 0, *case.name.encode()])
    delay_s = float(rng.uniform(0.0, 1.5))
    resumes = seed % 2 == 1
    world = world_of(seed, rng)
    config = config_of(seed, world, resumes)
    begins_s = _begins_s(config, world, at) + delay_s
    bench = _bench(config, world, case, begins_s)
    run = VirtualRun(config, bench, zernike_projection(), TruthShape(bench, config, seed))
    injection = Injection(case, bench)
    watch = Watch(case, at, bench, world.pressure_pa + GAUGE_MARGIN_PA, TICK_S, resumes)
    script = _Script(at, world)
    with _raising(case, injection):
        while run.now_s < begins_s + AFTERMATH_S and run.finished is None:
            if math.isnan(injection.started_s) and run.now_s >= begins_s:
                injection.begin(run.now_s)
                watch.begins(run.now_s)
            injection.update(run.now_s)
            watch.wrong_s = injection.last_on_s
            script.arrange(bench.wrong)
            watch.look(run.run_tick(script.commands(run.now_s)), run.now_s)
            script.follow(watch.state)
        watch.before_the_stop(run.now_s)
        stop: tuple[Command, ...] = (Command("stop", "campaign"),)
        while run.now_s < begins_s + AFTERMATH_S + THE_STOP_S:
            injection.update(run.now_s)
            watch.look(run.run_tick(stop), run.now_s)
            stop = ()
        watch.after_the_stop(run)
    cause = watch.names.get(watch.code, "")
    return Result(
        case.name, at.name, seed, cause, watch.deepest, watch.reaction_s, tuple(watch.violations)
    )


def config_of(seed: int, world: World, resumes: bool) -> Config:
    return Config(
        loop=LoopConfig(rate_hz=RATE_HZ),
        limits=LimitsConfig(
            displacement_min_um=DISPLACEMENT_MIN_UM,
            displacement_max_um=DISPLACEMENT_MAX_UM,
            gauge_pressure_max_pa=world.pressure_pa + GAUGE_MARGIN_PA,
            following_error_max_um=FOLLOWING_ERROR_MAX_UM,
            stale_s=STALE_S,
            gauge_stuck_s=GAUGE_STUCK_S,
        ),
        states=StatesConfig(
            stay_after_trip=True,
            settle_s=2.5,
            hold_flow_max_s=HOLD_FLOW_S,
            ramp_down_s=RAMP_S,
            pump_off_max_s=PUMP_OFF_S,
            pause_max_s=PAUSE_S,
            manual_max_s=MANUAL_S,
            manual_range_um=MANUAL_RANGE_UM,
        ),
        resume=ResumeConfig(
            faults=RESUMABLE if resumes else (), wait_s=RESUME_WAIT_S, most_per_day=RESUMES_A_DAY
        ),
        shape=ShapeConfig(fresh_s=6.0),
        twin=world.twin(seed),
    )


def _bench(
    config: Config, world: World, case: Case | None = None, begins_s: float = 0.0
) -> VirtualBench:
    """The mirror and its board; the plant gets events of the mirror itself beforehand."""
    events: list[AmbientChange | LeakChange] = []
    if case is not None and case.leak_factor != 1.0:
        events.append(LeakChange(begins_s, case.leak_factor))
    if case is not None and case.door_pa:
        events.append(AmbientChange(begins_s, case.door_pa))
    return VirtualBench(WatchedPlant(world, config.twin, config.pump, events), WATCHDOG_S)


_BEGINS: dict[tuple[int, World, str], float] = {}


def _begins_s(config: Config, world: World, at: Situation) -> float:
    """Time at which the situation is reached without a fault."""
    key = (config.twin.seed, world, at.name)
    if key not in _BEGINS:
        bench = _bench(config, world)
        run, script = VirtualRun(config, bench, zernike_projection()), _Script(at, world)
        while not script.there:
            assert run.now_s < GIVE_UP_S, f"{at.name} was not reached: {key}"
            script.arrange(bench.wrong)
            tick = run.run_tick(script.commands(run.now_s))
            assert tick is not None
            script.follow(State(int(tick.row.state)))
        _BEGINS[key] = run.now_s
    return _BEGINS[key]


def relay_about(flow_um_per_s: float) -> ExperimentSpec:
    """An experiment that swings the mirror by some µm."""
    return ExperimentSpec(
        kind="relay",
        duration_s=40.0,
        limit_um=8.0,
        holding_flow_um_per_s=flow_um_per_s,
        laser_um=1.0,
    )


class _Script:
    """The commands that lead to a situation."""

    def __init__(self, at: Situation, world: World) -> None:
        self._at, self._world = at, world
        self._hold_asked = self._held = self._gone = False
        self._asked, self._next_s = 0, 0.0
        self.there = False

    def follow(self, state: State) -> None:
        """Note where the controller is."""
        self._held = self._held or state == State.HOLD
        self.there = self.there or (state == self._at.state and self._asked >= len(self._at.asks))

    def arrange(self, wrong: Wrong) -> None:
        """The way into `fault` is a first fault: ticks that are late, until it is there."""
        if self._at.state == State.FAULT and self._held and not self._gone:
            wrong.late_ms = 0.0 if self.there else 150.0
            self._gone = self.there

    def commands(self, now_s: float) -> tuple[Command, ...]:
        """The commands of this tick."""
        asked: list[Command] = []
        if self._at.state != State.STANDBY and not self._hold_asked:
            self._hold_asked = True
            asked.append(Command("hold", "campaign"))
        asks = self._at.asks
        due = self._asked < len(asks) or (asks and math.isfinite(self._at.again_s))
        if self._held and due and now_s >= self._next_s:
            asked.append(self._command(*asks[self._asked % len(asks)]))
            self._asked += 1
            self._next_s = now_s + (self._at.again_s if math.isfinite(self._at.again_s) else 0.0)
        return tuple(asked)

    def _command(self, kind: Kind, value: float) -> Command:
        flow_um_per_s = self._world.holding_flow_um_per_s
        if kind == "manual":
            return Command("manual", "campaign", value=flow_um_per_s)
        if kind == "tune":
            return Command("tune", "campaign", experiment=relay_about(flow_um_per_s))
        return Command(kind, "campaign", value=value)


@contextlib.contextmanager
def _raising(case: Case, injection: Injection) -> Iterator[None]:
    """Let every handler raise once the fault has begun."""
    if not case.raises:
        yield
        return
    before = dict(state_handlers.HANDLERS)

    def breaking(state: State) -> None:
        def handler(context: TickContext) -> State:
            if not math.isnan(injection.started_s) and state != State.FAULT:
                raise ZeroDivisionError("injected")
            return before[state](context)

        state_handlers.HANDLERS[state] = handler

    try:
        for state in before:
            breaking(state)
        yield
    finally:
        state_handlers.HANDLERS.update(before)
