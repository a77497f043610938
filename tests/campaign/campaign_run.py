"""One run of the campaign: bring the controller into a state, let something go wrong, watch every tick."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from campaign_cases import (
    DISPLACEMENT_MAX_UM,
    DISPLACEMENT_MIN_UM,
    FOLLOWING_ERROR_MAX_UM,
    GAUGE_PRESSURE_MAX_PA,
    Case,
)
from campaign_watch import Watch

from membrane_ctrl import states
from membrane_ctrl.commands import Command
from membrane_ctrl.config import Config, LimitsConfig, LoopConfig, ShapeConfig, StatesConfig, TwinConfig
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.metrology.hencky import zernike_projection
from membrane_ctrl.names import Rung, State
from membrane_ctrl.safety import TABLE
from membrane_ctrl.twin.events import AmbientChange, LeakChange
from membrane_ctrl.twin.plant import Plant
from membrane_ctrl.virtual.bench import VirtualBench, Wrong
from membrane_ctrl.virtual.run import VirtualRun
from membrane_ctrl.virtual.shape import TruthShape

RATE_HZ = 25.0
AFTERMATH_S = 30.0
GIVE_UP_S = 120.0
_SCENARIOS = ("calm", "quiet", "typical", "gusty")
_RELAY = ExperimentSpec(kind="relay", duration_s=60.0, limit_um=8.0, holding_flow_um_per_s=1.24, laser_um=1.0)
_NAMES = {float(rule.code): rule.name for rule in TABLE} | {0.0: ""}


@dataclass(frozen=True)
class Result:
    """What came of one run; `violations` is empty when every invariant held."""

    case: str
    state: State
    seed: int
    said: str
    rung: Rung
    reaction_s: float
    violations: tuple[str, ...]


class Injection:
    """Puts the fault in at its time, and takes it away again."""

    def __init__(self, case: Case, bench: VirtualBench) -> None:
        self._case, self._bench = case, bench
        self._on = False
        self.started_s = math.nan
        self.ended_s = math.inf

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
            on = age_s < case.for_s
        else:
            on = age_s % case.every_s < case.for_s
        if on != self._on:
            self._on = on
            source = case.wrong if on else {name: getattr(Wrong(), name) for name in case.wrong}
            for name, value in source.items():
                setattr(self._bench.wrong, name, value)


def run_case(case: Case, state: State, seed: int) -> Result:
    """Run one cell of the matrix; equal arguments give equal results."""
    rng = np.random.default_rng([seed, int(state), *case.name.encode()])
    delay_s = float(rng.uniform(0.0, 1.5))
    config = _config(seed, str(rng.choice(_SCENARIOS)))
    begins_s = _begins_s(config, state, delay_s)
    plant = Plant(config.twin, config.pump, _events(case, begins_s))
    bench = VirtualBench(plant)
    run = VirtualRun(config, bench, zernike_projection(), TruthShape(bench, config, seed))
    injection, watch = Injection(case, bench), Watch(case, bench, config)
    script = _Script(state)
    with _raising(case, injection):
        while run.finished is None and run.now_s < begins_s + AFTERMATH_S:
            if math.isnan(injection.started_s) and run.now_s >= begins_s:
                injection.begin(run.now_s)
                watch.begins(run.now_s)
            injection.update(run.now_s)
            script.arrange(bench.wrong)
            watch.look(run.tick(script.commands(run.now_s)), run.now_s)
            script.follow(watch.state)
        watch.ends(run)
    return Result(
        case.name, state, seed, _NAMES[watch.code], watch.deepest, watch.reaction_s, tuple(watch.violations)
    )


def _config(seed: int, scenario: str) -> Config:
    return Config(
        loop=LoopConfig(rate_hz=RATE_HZ),
        limits=LimitsConfig(
            displacement_min_um=DISPLACEMENT_MIN_UM,
            displacement_max_um=DISPLACEMENT_MAX_UM,
            gauge_pressure_max_pa=GAUGE_PRESSURE_MAX_PA,
            following_error_max_um=FOLLOWING_ERROR_MAX_UM,
        ),
        states=StatesConfig(stay_after_trip=True, settle_s=2.5),
        shape=ShapeConfig(fresh_s=6.0),
        twin=TwinConfig(seed=seed, scenario=scenario, start_error_um=-15.0),  # type: ignore[arg-type]
    )


def _events(case: Case, begins_s: float) -> tuple[AmbientChange | LeakChange, ...]:
    """What happens to the mirror itself: the plant is told beforehand."""
    found: list[AmbientChange | LeakChange] = []
    if case.leak_factor != 1.0:
        found.append(LeakChange(begins_s, case.leak_factor))
    if case.door_pa:
        found.append(AmbientChange(begins_s, case.door_pa))
    return tuple(found)


_BEGINS: dict[tuple[int, str, State], float] = {}


def _begins_s(config: Config, state: State, delay_s: float) -> float:
    """When the state is reached without a fault, and some of it has passed."""
    key = (config.twin.seed, config.twin.scenario, state)
    if key not in _BEGINS:
        bench = VirtualBench(Plant(config.twin, config.pump))
        run, script, entered_s = VirtualRun(config, bench, zernike_projection()), _Script(state), math.nan
        while math.isnan(entered_s):
            assert run.now_s < GIVE_UP_S, f"{state.name} was not reached: {key}"
            script.arrange(bench.wrong)
            tick = run.tick(script.commands(run.now_s))
            assert tick is not None
            script.follow(State(int(tick.row.state)))
            if tick.row.state == state:
                entered_s = run.now_s
        _BEGINS[key] = entered_s
    return _BEGINS[key] + delay_s


class _Script:
    """The commands that lead to a state."""

    def __init__(self, state: State) -> None:
        self._goal = state
        self._asked: set[str] = set()
        self._held = self._there = self._gone = False

    def follow(self, state: State) -> None:
        """Note where the controller is."""
        self._held = self._held or state == State.HOLD
        self._there = self._there or state == self._goal

    def arrange(self, wrong: Wrong) -> None:
        """The way into `fault` is a first fault: ticks that are late, until it is there."""
        if self._goal == State.FAULT and self._held and not self._gone:
            wrong.late_ms = 0.0 if self._there else 150.0
            self._gone = self._there

    def commands(self, now_s: float) -> tuple[Command, ...]:
        asked: list[Command] = []
        if self._goal != State.STANDBY:
            asked += self._once(Command("hold", "campaign"))
        if self._held and self._goal == State.MANUAL:
            asked += self._once(Command("manual", "campaign", value=1.2))
        if self._held and self._goal == State.TUNE:
            asked += self._once(Command("tune", "campaign", experiment=_RELAY))
        if self._held and self._goal == State.LOWER:
            asked += self._once(Command("vent", "campaign"))
        return tuple(asked)

    def _once(self, command: Command) -> list[Command]:
        if command.kind in self._asked:
            return []
        self._asked.add(command.kind)
        return [command]


@contextlib.contextmanager
def _raising(case: Case, injection: Injection) -> Iterator[None]:
    """Let every handler raise once the fault has set in."""
    if not case.raises:
        yield
        return
    before = dict(states.HANDLERS)

    def breaking(state: State) -> None:
        def handler(scene: states.Scene) -> State:
            if not math.isnan(injection.started_s) and state != State.FAULT:
                raise ZeroDivisionError("injected")
            return before[state](scene)

        states.HANDLERS[state] = handler

    try:
        for state in before:
            breaking(state)
        yield
    finally:
        states.HANDLERS.update(before)
