"""Stories of sensors and actuators: stopped clocks, creeping lasers, pumps that do not obey."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from campaign_run import config_of
from campaign_stage import Stage, sensors_say
from campaign_times import DISPLACEMENT_MAX_UM, TICK_S
from campaign_world import World

from membrane_ctrl.config.schema import EstimatorConfig, ShapeConfig
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.telemetry import State


def a_clock_that_stands() -> list[str]:
    """The sample counter advances, but the sample time does not: the samples are not new."""
    stage = Stage().held()
    at_s = stage.plant.time_s
    sensors_say(stage, lambda sample: replace(sample, device_time_s=at_s))
    stage.wait(1.0)
    stage.bench.wrong.laser_offset_um = -15.0
    before_um = stage.plant.truth().displacement_um
    stage.wait(12.0)
    went_um = stage.plant.truth().displacement_um - before_um
    stage.must(abs(went_um) < 10.0, f"followed samples of the past by {went_um:.0f} µm")
    stage.wait(15.0)
    stage.wait(5.0, stage.still)
    return stage.violations


def a_laser_that_doubts_itself() -> list[str]:
    """The laser's quality marks its readings as invalid: the loop does not follow them."""
    stage = Stage().held()
    sensors_say(
        stage, lambda sample: replace(sample, displacement_um=-15.0, displacement_quality=2)
    )
    before_um = stage.plant.truth().displacement_um
    stage.wait(7.0)
    went_um = stage.plant.truth().displacement_um - before_um
    stage.must(abs(went_um) < 10.0, f"followed a reading of bad quality by {went_um:.0f} µm")
    stage.wait(10.0)
    stage.wait(5.0, stage.still)
    return stage.violations


def pressure_that_is_seen_now_and_then() -> list[str]:
    """The gauge has a value on every fourth tick only, each above the limit: the vent opens."""
    stage = Stage().held()
    stage.bench.wrong.gauge_offset_pa = 60.0
    for number in range(40):
        stage.bench.wrong.gauge_lost = number % 4 != 0
        stage.tick()
    stage.must(
        stage.plant.vent_given == 1.0, "over its limit whenever it speaks, and the vent is shut"
    )
    return stage.violations


def pressure_in_standby() -> list[str]:
    """Over-pressure opens the vent in standby as well."""
    stage = Stage()
    stage.wait(2.0)
    stage.bench.wrong.gauge_offset_pa = 60.0
    stage.wait(1.0)
    stage.must(stage.plant.vent_given == 1.0, "over-pressure in standby, and the vent is shut")
    return stage.violations


def creeping(stage: Stage, um_per_s: float, deepest_um: float) -> Callable[[], str]:
    """The laser's mount moves by a tick's drift; the violation if the
    bowl has followed it too far.
    """

    def creep() -> str:
        stage.bench.wrong.laser_offset_um -= um_per_s * TICK_S
        deep_um = stage.plant.truth().displacement_um
        return f"the bowl followed the laser to {deep_um:.0f} µm" if deep_um > deepest_um else ""

    return creep


def a_creeping_laser() -> list[str]:
    """The laser's mount starts to drift at 0.5 µm/s; camera and gauge detect it."""
    stage = Stage(camera=True).held()
    stage.wait(60.0)
    stage.wait(150.0, creeping(stage, 0.5, DISPLACEMENT_MAX_UM))
    return stage.violations


def a_stuck_gauge_and_a_creeping_laser() -> list[str]:
    """No camera; the gauge freezes, then the laser's mount starts to drift at 2 µm/s."""
    stage = Stage().held()
    stage.wait(10.0)
    stage.bench.wrong.gauge_stuck = True
    stage.wait(120.0, creeping(stage, 2.0, 60.0))
    stage.wait(5.0, stage.still)
    return stage.violations


def a_creeping_laser_without_a_camera() -> list[str]:
    """The laser's mount starts to drift at 1 µm/s; the gauge alone detects it."""
    stage = Stage().held()
    stage.wait(60.0)
    stage.wait(300.0, creeping(stage, 1.0, 70.0))
    stage.wait(5.0, stage.still)
    return stage.violations


def by_optics() -> Stage:
    """A held bench without a laser, with ten figures a second."""
    world = World()
    config = config_of(1, world, False)
    return Stage(
        world=world,
        camera=True,
        config=config.model_copy(
            update={
                "estimator": EstimatorConfig(process_value="optics"),
                "shape": ShapeConfig(mode="track", track_rate_hz=10.0),
                "twin": config.twin.model_copy(update={"laser": False}),
            }
        ),
    ).held()


def a_camera_lost_on_a_bench_without_a_laser() -> list[str]:
    """Nothing sees the film any more: the mean flow, then the pump off."""
    stage = by_optics()
    stage.wait(10.0)
    stage.bench.wrong.camera_lost = True
    before_um = stage.plant.truth().displacement_um
    stage.wait(8.0)
    went_um = stage.plant.truth().displacement_um - before_um
    stage.must(abs(went_um) < 10.0, f"went {went_um:.0f} µm without a figure")
    stage.until(State.FAULT, 6.0)
    stage.wait(8.0)
    stage.wait(5.0, stage.still)
    return stage.violations


def figures_without_a_usable_sigma() -> list[str]:
    """No laser, and the figures have no standard deviation, or one as large as the film's sag: they
    hold nothing, and the pump stops.
    """
    violations = []
    for sigma_um in (math.nan, 1e4, -1.0):
        stage = by_optics()
        stage.wait(10.0)
        stage.change_figure = lambda figure, sigma_um=sigma_um: replace(  # type: ignore[misc]
            figure, sag_change_sigma_um=sigma_um
        )
        stage.until(State.FAULT, 20.0)
        stage.wait(8.0)
        stage.wait(5.0, stage.still)
        violations += stage.violations
    return violations


def optics_that_creep_without_a_laser() -> list[str]:
    """The stand sinks and the sag seems to shrink by 1 µm/s; the gauge alone detects it."""
    stage = by_optics()
    stage.wait(60.0)

    def creep() -> str:
        stage.bench.wrong.camera_offset_um -= TICK_S
        deep_um = stage.plant.truth().displacement_um
        return f"the bowl followed the optics to {deep_um:.0f} µm" if deep_um > 70.0 else ""

    stage.wait(300.0, creep)
    stage.wait(5.0, stage.still)
    return stage.violations


def a_seam_that_opens() -> list[str]:
    """No camera; the film suddenly takes three times as much gas: the pump stops."""
    stage = Stage().held()
    stage.wait(90.0)
    stage.bench.wrong.vent_stuck_fraction = 0.024
    stage.wait(150.0)
    stage.wait(5.0, stage.still)
    return stage.violations


def a_setpoint_is_reached() -> list[str]:
    """A setpoint 15 µm higher moves the true mirror by 15 µm, and the gauge shows the true
    pressure.
    """
    stage = Stage(camera=True).held()
    stage.ask("setpoint", value=15.0)
    stage.wait(40.0)
    stage.near(15.0, 6.0)
    return stage.violations


def dead_actuators_are_found() -> list[str]:
    """A dead vent is found before the hold, a dead pump soon after (noise may let it pass the
    test).
    """
    violations = []
    config = config_of(1, World(), False)
    timed = config.states.model_copy(update={"inflate_timeout_s": 60.0})
    for name in ("pump_stuck_fraction", "vent_stuck_fraction"):
        stage = Stage(config=config.model_copy(update={"states": timed}))
        setattr(stage.bench.wrong, name, 0.0)
        stage.ask("hold")
        stage.wait(30.0)
        stage.must(stage.state != State.CHECK, f"{name}: the start test does not end")
        stage.wait(60.0, lambda at=stage: "held" if at.state == State.HOLD else "")
        stage.must(stage.state == State.FAULT, f"{name}: no fault")
        if name == "vent_stuck_fraction":
            stage.must(stage.plant.truth().displacement_um < 0.0, "inflated without a vent")
        violations += stage.violations
    return violations


def a_fill_that_leaks_ends() -> list[str]:
    """The mirror does not rise: the fill times out."""
    config = config_of(1, World(), False)
    timed = config.states.model_copy(update={"inflate_timeout_s": 40.0})
    stage = Stage(config=config.model_copy(update={"states": timed}))
    stage.ask("hold")
    stage.until(State.INFLATE)
    stage.bench.wrong.vent_stuck_fraction = 0.08  # 8 µm/s: more than the pump has
    stage.wait(60.0)
    stage.wait(20.0, stage.still)
    stage.must(stage.state == State.FAULT, "a fill without an end")
    return stage.violations


def a_pump_that_does_not_obey_the_stop() -> list[str]:
    """Pump and read-back stay on: the stop does not succeed, and the vent opens."""
    violations = []
    for way in ("stop", "lower", "vent"):
        stage = Stage().held()
        stage.bench.wrong.readback_fraction = stage.bench.wrong.pump_stuck_fraction = 0.9
        stage.ask(way)  # type: ignore[arg-type]
        stage.wait(30.0)
        stage.must(stage.plant.vent_given == 1.0, "the pump runs on, and the vent is shut")
        finished = stage.run.finished
        stage.must(finished not in (Exit.DONE, Exit.INTERRUPTED), "the stop is called a success")
        stage.must(way == "stop" or stage.state == State.FAULT, "called no fault")
        violations += [f"{way}: {what}" for what in stage.violations]
    return violations


def a_pump_that_runs_behind_its_readback() -> list[str]:
    """In standby the read-back says 0 while gas comes in: the vent opens long before a limit is
    reached.
    """
    config = config_of(1, World(), False)
    wide = config.limits.model_copy(
        update={"gauge_pressure_max_pa": 750.0, "displacement_max_um": 1000.0}
    )
    stage = Stage(config=config.model_copy(update={"limits": wide}))
    stage.wait(10.0)
    stage.bench.wrong.pump_stuck_fraction = 0.9
    stage.wait(60.0)
    stage.must(stage.plant.vent_given == 1.0, "gas comes in, and the vent is shut")
    return stage.violations


def a_pump_that_starts_in_standby() -> list[str]:
    """The pump runs without a command."""
    stage = Stage()
    stage.wait(5.0)
    stage.bench.wrong.readback_fraction = stage.bench.wrong.pump_stuck_fraction = 0.9
    stage.wait(30.0)
    stage.must(stage.plant.vent_given == 1.0, "the pump runs in standby, and the vent is shut")
    return stage.violations


STORIES: Sequence[Callable[[], list[str]]] = (
    a_clock_that_stands,
    a_laser_that_doubts_itself,
    pressure_that_is_seen_now_and_then,
    pressure_in_standby,
    a_creeping_laser,
    a_stuck_gauge_and_a_creeping_laser,
    a_creeping_laser_without_a_camera,
    a_camera_lost_on_a_bench_without_a_laser,
    figures_without_a_usable_sigma,
    optics_that_creep_without_a_laser,
    a_seam_that_opens,
    a_setpoint_is_reached,
    dead_actuators_are_found,
    a_fill_that_leaks_ends,
    a_pump_that_does_not_obey_the_stop,
    a_pump_that_runs_behind_its_readback,
    a_pump_that_starts_in_standby,
)
