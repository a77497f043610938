"""A mirror held by the estimate of its centre, in virtual time, with intermittent sensors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from membrane_ctrl.config.schema import Config, EstimatorConfig, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.snapshot import continue_from, take_snapshot
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Fault, SensorsUsed, Why
from membrane_ctrl.model.telemetry import SafeLevel, State
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench, Wrong

CONFIG = Config(
    estimator=EstimatorConfig(process_value="estimate"),
    twin=TwinConfig(start_error_um=-1.0, scenario="quiet"),
)
FROM_S, UNTIL_S = 18.0, 25.0  # of a failure


def held(
    fail: Callable[[Wrong, bool], None],
    config: Config = CONFIG,
    shape_s: float = 0.06,
    until_s: float = 31.0,
) -> list[VirtualTick]:
    """A hold with figures every `shape_s`, in which something fails for a while."""
    bench = VirtualBench(Plant(config.twin, config.pump))
    run = VirtualRun(config, bench, zernike_projection(), TruthShape(bench, config, 3, 0.036))
    run._shape_period_s = shape_s  # tracking
    ticks: list[VirtualTick] = []
    while run.now_s < until_s:
        fail(bench.wrong, FROM_S <= run.now_s < UNTIL_S)
        tick = run.run_tick(() if ticks else (Command("hold", "a test", "it runs"),))
        if tick is None:  # the run has ended
            break
        ticks.append(tick)
    return ticks


def moved_um(ticks: list[VirtualTick]) -> float:
    """How far the true centre went from its mean before the failure."""
    time_s, centre_um = np.array(
        [(tick.row.mono_s, tick.row.truth_displacement_um) for tick in ticks]
    ).T
    before = centre_um[(time_s > FROM_S - 5) & (time_s < FROM_S)].mean()
    return float(np.abs(centre_um[time_s >= FROM_S] - before).max())


def list_used_sensors(ticks: list[VirtualTick]) -> list[str]:
    """Which sensors hold the mirror, as reported."""
    return [
        ", ".join(event.sensors)
        for tick in ticks
        for event in tick.events
        if isinstance(event, SensorsUsed)
    ]


ALL = "laser, optics, barometer, thermometer"


def set_to(name: str, value: float | bool) -> Callable[[Wrong, bool], None]:
    """A switch that has a value while something fails."""
    return lambda wrong, fails: setattr(wrong, name, value if fails else type(value)(0))


LASER_LOST = set_to("no_light", True)
LASER_STUCK = set_to("laser_stuck", True)


@pytest.mark.parametrize(
    ("fail", "used_sensors"),
    [
        (LASER_LOST, [ALL, "optics, barometer, thermometer", ALL]),
        pytest.param(LASER_STUCK, [ALL], marks=pytest.mark.campaign),
        (set_to("camera_lost", True), [ALL, "laser, barometer, thermometer", ALL]),
        pytest.param(
            set_to("barometer_lost", True),
            [ALL, "laser, optics, thermometer", ALL],
            marks=pytest.mark.campaign,
        ),
        pytest.param(set_to("laser_offset_um", 12.0), [ALL, ALL, ALL], marks=pytest.mark.campaign),
    ],
    ids=["no laser", "stuck laser", "no camera", "no barometer", "knocked laser"],
)
def test_a_lost_sensor_causes_neither_a_step_nor_a_fault(
    fail: Callable[[Wrong, bool], None], used_sensors: list[str]
) -> None:
    ticks = held(fail)
    # A laser that sticks while its mean still defines the optics' zero moves that zero
    assert moved_um(ticks) < (0.6 if fail is LASER_STUCK else 0.3)
    assert not [event for tick in ticks for event in tick.events if isinstance(event, Fault)]
    assert list_used_sensors(ticks) == used_sensors
    alone = [
        event
        for tick in ticks
        for event in tick.events
        if isinstance(event, Why) and "optics alone" in event.why
    ]
    # A stuck laser is left out as well, for less time than the list of sensors waits.
    laser_is_left_out = fail in (LASER_LOST, LASER_STUCK)
    assert len(alone) == int(laser_is_left_out)
    assert ticks[-1].row.state == State.HOLD


@pytest.mark.campaign
def test_without_laser_and_optics_the_flow_is_held_until_one_returns() -> None:
    def fail(wrong: Wrong, fails: bool) -> None:
        wrong.no_light = wrong.camera_lost = fails

    ticks = held(fail)
    safe_levels = [tick.row.safe_level for tick in ticks if tick.row.mono_s > FROM_S + 6]
    assert safe_levels[0] == SafeLevel.HOLD_FLOW
    assert safe_levels[-1] == SafeLevel.NONE


def test_by_default_the_loop_controls_the_laser_reading() -> None:
    ticks = held(set_to("no_light", True), Config(twin=CONFIG.twin), until_s=19.0)
    assert list_used_sensors(ticks) == []
    assert ticks[-1].row.safe_level == SafeLevel.HOLD_FLOW


def test_the_depth_stays_limited_without_a_laser() -> None:
    """A film that the optics see too deep is vented, although no laser says so."""
    limits = CONFIG.limits.model_copy(update={"displacement_max_um": 10.0})

    def fail(wrong: Wrong, fails: bool) -> None:
        wrong.no_light = fails
        wrong.camera_offset_um = 15.0 if fails else 0.0

    config = CONFIG.model_copy(update={"limits": limits})
    faults = [
        event.name
        for tick in held(fail, config, until_s=21.0)
        for event in tick.events
        if isinstance(event, Fault)
    ]
    assert faults == ["over_displacement"]


def test_a_replay_from_a_snapshot_is_the_same_to_the_last_bit() -> None:
    bench = VirtualBench(Plant(CONFIG.twin, CONFIG.pump))
    run = VirtualRun(CONFIG, bench, zernike_projection(), TruthShape(bench, CONFIG, 3, 0.036))
    run._shape_period_s = 0.06
    controller = run._supervisor._controller
    fresh: Controller | None = None
    for n in range(600):
        if n == 500:
            fresh = continue_from(take_snapshot(controller), CONFIG, zernike_projection())
        tick = run.run_tick(() if n else (Command("hold", "a test", "it runs"),))
        assert tick is not None
        if fresh is not None:
            assert fresh.tick(tick.inputs) == tick.outputs
    assert tick.row.state == State.HOLD
