"""Recorded runs of the twin that reach every part of the controller's state, for tests of snapshots
and replay.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from firmware_iface.settings import BoardInputConfig
from membrane_ctrl.config.schema import (
    Config,
    DevicesConfig,
    EstimatorConfig,
    LoopConfig,
    PumpConfig,
    ResumeConfig,
    ShapeConfig,
    StatesConfig,
    TwinConfig,
)
from membrane_ctrl.control.experiments.spec import ExperimentSpec, PumpStep
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.snapshot import continue_from, take_snapshot
from membrane_ctrl.controller.state import ControllerState
from membrane_ctrl.controller.tick import TickInputs, TickOutputs
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.sim.bench_events import BenchEvent
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench, Wrong
from membrane_ctrl.sim.virtual_interlocks import VirtualInterlocks

Ticks = list[tuple[TickInputs, TickOutputs]]
_TWIN = TwinConfig(scenario="quiet", start_error_um=-1.0, laser_noise_um=0.5)
_HOLD = Command("hold", "a test", "it runs")


@dataclass(frozen=True, slots=True)
class Story:
    """What happens in a run: commands by time, failures from and to a time."""

    config: Config
    until_s: float
    commands: Mapping[float, Command] = field(default_factory=dict)
    failures: Mapping[tuple[float, float], Callable[[Wrong, bool], None]] = field(
        default_factory=dict
    )
    shape_s: float | None = None
    surroundings: tuple[BenchEvent, ...] = ()
    actions: Mapping[float, Callable[[VirtualBench], None]] = field(default_factory=dict)
    continued_at_s: tuple[
        float, ...
    ] = ()  # the controller is replaced by one made from its snapshot


def switched(name: str, value: float | bool) -> Callable[[Wrong, bool], None]:
    """Set a failure while it lasts, and its default otherwise."""
    default = getattr(Wrong(), name)
    return lambda wrong, fails: setattr(wrong, name, value if fails else default)


def _trial(kind: str, **changed: Any) -> Command:
    given = {
        "kind": kind,
        "duration_s": 15.0,
        "holding_flow_um_per_s": 1.24,
        "laser_um": 0.5,
    } | changed
    return Command("tune", "tester", experiment=ExperimentSpec.model_validate(given), number=7)


_CURVE = PumpConfig(
    curve_fraction=(0.1, 0.5, 1.0),
    curve_um_per_s=(0.0, 2.5, 5.3),
    curve_falling_um_per_s=(0.1, 2.9, 5.3),
    flow_full_um_per_s=5.3,
)
_SAFE = StatesConfig(stay_after_trip=True)
_LOOP = LoopConfig(rate_hz=20.0)
_DOOR = BoardInputConfig(
    driver="board_input", name="door", text="shut the door", safe_level="pump_off", input=3
)
_LOCK = Lock("bofak", "hands inside", "unix:ann", "unix:ann", "p 7", "")
_TUNED = Config(twin=_TWIN, loop=_LOOP, shape=ShapeConfig(enabled=False))


def _gains(kp_per_s: float, trial_s: float, **changed: Any) -> Command:
    loop = _LOOP.model_copy(update={"kp_per_s": kp_per_s})
    return Command("gains", "tester", value=trial_s, loop=loop, **changed)


# Every state of the controller, every sensor lost, gains on trial and all experiments
STORIES: dict[str, Story] = {
    "laser": Story(
        Config(twin=_TWIN, loop=_LOOP),
        90.0,
        {
            0.05: _HOLD,
            18.0: Command("setpoint", "ann", value=4.0),
            24.0: Command("pause", "ann"),
            26.0: Command("resume", "ann"),
            27.0: Command("manual", "ann", value=1.5),
            29.0: Command("hold", "ann"),
            52.0: Command("shape_off", "ann"),
            54.0: Command("shape_on", "ann"),
        },
        {
            (40.0, 42.0): switched("no_light", True),
            (45.0, 50.0): switched("barometer_lost", True),
            (60.0, 90.0): switched("camera_offset_um", 14.0),
            (70.0, 72.0): switched("gauge_offset_pa", 3.0),
        },
        shape_s=1.0,
    ),
    "estimate": Story(
        Config(twin=_TWIN, estimator=EstimatorConfig(process_value="estimate")),
        50.0,
        {0.02: _HOLD, 32.0: Command("shape_off", "ann"), 34.0: Command("shape_on", "ann")},
        {
            (18.0, 21.0): switched("no_light", True),
            (24.0, 26.0): switched("camera_lost", True),
            (28.0, 50.0): switched("laser_offset_um", 13.0),
            (38.0, 41.0): switched("laser_stuck", True),
            (44.0, 50.0): switched("camera_offset_um", 13.0),
        },
        shape_s=0.06,
    ),
    "optics": Story(
        Config(
            twin=_TWIN.model_copy(update={"laser": False}),
            loop=_LOOP,
            estimator=EstimatorConfig(process_value="optics"),
            shape=ShapeConfig(mode="track"),
        ),
        40.0,
        {0.05: _HOLD, 26.0: _trial("relay", duration_s=8.0, laser_um=0.05)},
        {(20.0, 23.0): switched("camera_lost", True)},
        shape_s=0.06,
    ),
    "faults": Story(
        Config(
            twin=_TWIN,
            loop=_LOOP,
            states=_SAFE,
            resume=ResumeConfig(
                faults=("link_lost", "device_silent", "watchdog_tripped"), wait_s=1.0
            ),
            devices=DevicesConfig(board="tcp://twin", interlocks=(_DOOR,)),
        ),
        80.0,
        {
            0.05: Command("hold", "a test"),
            40.0: Command("latch", "ann", text="x", lock=_LOCK),
            43.0: Command("unlock", "ann", text="bofak", account="unix:ann"),
            44.0: Command("ack", "ann"),
            45.0: Command("hold", "ann"),
            72.0: Command("vent", "ann"),
            76.0: Command("ack", "ann"),
        },
        {(18.0, 20.0): switched("unreachable", True), (66.0, 68.0): switched("open_interlocks", 8)},
        shape_s=1.0,
    ),
    "gains": Story(
        _TUNED,
        60.0,
        {
            0.05: _HOLD,
            18.0: _gains(0.3, 10.0, setpoint_step_um=2.0),
            22.0: Command("keep", "t"),
            24.0: _gains(0.5, 6.0, shape_time_constant_s=90.0),
            34.0: _gains(0.4, float("nan"), pump=_CURVE),
        },
    ),
    "doublets, steps, multisine": Story(
        _TUNED,
        75.0,
        {
            0.05: _HOLD,
            18.0: _trial("doublets", duration_s=8.0),
            34.0: _trial("steps", duration_s=8.0),
            50.0: _trial("multisine", duration_s=10.0),
            54.0: _gains(0.5, 4.0),
        },
    ),
    "relay, pump map": Story(
        _TUNED,
        85.0,
        {
            0.05: _HOLD,
            18.0: _trial("relay", duration_s=25.0),
            58.0: _trial(
                "pump_map",
                duration_s=60.0,
                steps=(
                    PumpStep(fraction=0.0, duration_s=8.0, until_um=-4.0),
                    PumpStep(fraction=0.6, duration_s=3.0, until_um=3.0),
                    PumpStep(fraction=0.0, duration_s=6.0),
                ),
            ),
        },
        {(30.0, 30.2): switched("no_light", True)},
    ),
    "check": Story(
        Config(
            twin=_TWIN.model_copy(update={"laser_noise_um": 3.0}),
            states=StatesConfig(actuator_test=True),
        ),
        12.0,
        {0.02: _HOLD},
        {(1.0, 1.3): switched("no_light", True), (4.0, 9.0): switched("pump_share", 0.2)},
    ),
    "slow check": Story(
        Config(twin=_TWIN, loop=_LOOP, states=StatesConfig(actuator_test=False)), 8.0, {0.05: _HOLD}
    ),
}


def record_story(story: Story) -> tuple[Ticks, ControllerState]:
    """Run a story in virtual time; returns inputs and outputs of its ticks, and the controller's
    last state.
    """
    config = story.config
    circuits = VirtualInterlocks(config.interlocks)
    bench = VirtualBench(Plant(config.twin, config.pump, story.surroundings), interlocks=circuits)
    source = None if story.shape_s is None else TruthShape(bench, config, 3, 0.036)
    run = VirtualRun(config, bench, zernike_projection(), source)
    if story.shape_s is not None:
        run._shape_period_s = story.shape_s
    waiting = dict(story.commands)
    actions = dict(story.actions)
    continuations = list(story.continued_at_s)
    active: set[tuple[float, float]] = set()
    ticks: Ticks = []
    while run.now_s < story.until_s and run.finished is None:
        for window, fail in story.failures.items():
            fails = window[0] <= run.now_s < window[1]
            if fails != (window in active):
                fail(bench.wrong, fails)
                active ^= {window}
        for time_s in [time_s for time_s in actions if time_s <= run.now_s]:
            actions.pop(time_s)(bench)
        if continuations and continuations[0] <= run.now_s:
            continuations.pop(0)
            snapshot = take_snapshot(run._supervisor._controller)
            run._supervisor._controller = continue_from(snapshot, config, zernike_projection())
        due = [time_s for time_s in waiting if time_s <= run.now_s + 1e-9]
        tick = run.run_tick(tuple(waiting.pop(time_s) for time_s in due))
        if tick is not None:
            ticks.append((tick.inputs, tick.outputs))
    return ticks, run._supervisor._controller.memory
