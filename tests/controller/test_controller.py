"""The whole tick on the twin in virtual time: states, safe actions, and the messages."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from firmware_iface.roles import BenchCommand, BenchReading
from membrane_ctrl.config.schema import Config, LimitsConfig, LoopConfig, StatesConfig, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.tick_context import TickContext
from membrane_ctrl.hold.virtual_run import VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.events import EventLine, Why
from membrane_ctrl.model.telemetry import SafeLevel, State
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.worlds.virtual_record import run_virtual

CALM = Config(twin=TwinConfig(scenario="calm", laser_noise_um=0.3))
Alter = Callable[[float, BenchReading], BenchReading | None]


class Run:
    """A virtual run, kept whole."""

    def __init__(
        self, config: Config = CALM, duration_s: float = 40.0, alter: Alter | None = None
    ) -> None:
        plant = Plant(config.twin, config.pump)
        self.ticks: list[VirtualTick] = list(
            run_virtual(config, plant, duration_s, zernike_projection(), alter=alter)
        )
        self.rows = [tick.row for tick in self.ticks]
        self.events: list[EventLine] = [
            {**event.to_dict(), "mono_s": tick.row.mono_s}
            for tick in self.ticks
            for event in tick.events
        ]
        self.finished = self.ticks[-1].outputs.finished

    def of(self, kind: str) -> list[EventLine]:
        return [event for event in self.events if event["kind"] == kind]

    @property
    def states(self) -> list[str]:
        return [event["state"] for event in self.of("state")]

    def value(self, field: str) -> Any:
        return np.array([getattr(row, field) for row in self.rows])


def after(
    start_s: float, until_s: float, change: Callable[[BenchReading], BenchReading | None]
) -> Alter:
    return lambda now_s, reading: change(reading) if start_s <= now_s < until_s else reading


def test_a_normal_run_passes_its_states_and_ends_with_the_pump_off() -> None:
    run = Run(Config(), 40.0)
    assert run.states == ["check", "inflate", "settle", "hold", "lower"]
    assert run.of("state")[3]["mono_s"] <= 15.0
    assert run.finished == Exit.DONE
    assert run.rows[-1].pump_fraction == 0.0
    assert not run.of("fault")
    held = run.value("state") == State.HOLD
    assert np.std(run.value("truth_displacement_um")[held]) < 0.3


@pytest.mark.parametrize("state", [State.STANDBY, State.LOWER])
def test_the_pump_is_off_in_states_that_do_not_hold(state: State) -> None:
    run = Run()
    pump = run.value("pump_fraction")[run.value("state") == state]
    assert np.all(pump == 0.0)


def test_ten_seconds_without_a_laser_are_held_on_the_mean_flow_without_a_latched_fault() -> None:
    lost = after(25.0, 35.0, lambda r: replace(r, displacement_um=math.nan, displacement_quality=1))
    run = Run(CALM, 45.0, lost)
    assert [f["name"] for f in run.of("fault")] == ["displacement_missing"]
    assert run.of("fault")[0]["mono_s"] == pytest.approx(25.04, abs=0.021)  # three ticks in a row
    assert len(run.of("cleared")) == 1
    assert run.finished == Exit.DONE
    gone = (run.value("mono_s") > 25.1) & (run.value("mono_s") < 34.9)
    assert np.ptp(run.value("pump_fraction")[gone]) < 0.02  # the mean flow, and nothing else
    assert np.max(np.abs(run.value("truth_displacement_um")[gone])) < 4.0


def test_the_pump_is_handed_over_to_a_person_and_back_without_a_gap() -> None:
    plant = Plant(CALM.twin, CALM.pump)
    run = VirtualRun(CALM, VirtualBench(plant, 0.5), zernike_projection())
    rows = []
    asked = {1: "hold", 1000: "manual", 1500: "hold"}
    for number in range(1, 2000):
        commands = (Command(asked[number], "engineer", value=1.2),) if number in asked else ()
        tick = run.run_tick(commands)
        assert tick is not None
        rows.append(tick.row)
    assert {State(row.state) for row in rows[1000:1499]} == {State.MANUAL}
    assert State(rows[-1].state) == State.HOLD
    assert min(row.pump_fraction for row in rows[990:]) > 0.2


def test_the_operator_line_names_the_sender_of_the_command_only() -> None:
    run = VirtualRun(CALM, VirtualBench(Plant(CALM.twin, CALM.pump), 0.5), zernike_projection())
    asked = {
        1: Command("hold", "ann"),
        1000: Command("pause", "ann"),
        1001: Command("shape_off", "bob"),
    }
    events = [
        event.why
        for number in range(1, 1200)
        if (tick := run.run_tick((asked[number],) if number in asked else ())) is not None
        for event in tick.events
        if isinstance(event, Why)
    ]
    assert events[-1].startswith("paused by ann")


def test_one_or_two_repeated_samples_are_no_fault() -> None:
    held: list[BenchReading] = []

    def repeat_two(now_s: float, reading: BenchReading) -> BenchReading:
        held[:] = held if 25.0 <= now_s < 25.03 and held else [reading]
        return held[0]

    run = Run(CALM, 30.0, repeat_two)
    assert not run.of("fault")
    assert run.finished == Exit.DONE


def test_a_lasting_laser_loss_escalates_through_the_safe_levels() -> None:
    lost = after(
        25.0, math.inf, lambda r: replace(r, displacement_um=math.nan, displacement_quality=1)
    )
    config = CALM.model_copy(update={"states": StatesConfig(hold_flow_max_s=2.0, ramp_down_s=3.0)})
    run = Run(config, 60.0, lost)
    assert run.finished == Exit.SAFETY_TRIP
    safe_levels = [SafeLevel(safe_level) for safe_level in dict.fromkeys(run.value("safe_level"))]
    assert safe_levels == [
        SafeLevel.NONE,
        SafeLevel.HOLD_FLOW,
        SafeLevel.RAMP_DOWN,
        SafeLevel.PUMP_OFF,
    ]
    ramp = run.value("pump_fraction")[run.value("safe_level") == SafeLevel.RAMP_DOWN]
    assert np.all(np.diff(ramp) <= 0)
    assert run.rows[-1].pump_fraction == 0.0
    assert [f["name"] for f in run.of("fault")] == ["displacement_missing"]  # the first cause, once


@pytest.mark.parametrize(
    ("name", "change", "safe_level"),
    [
        ("over_pressure", lambda r: replace(r, gauge_pressure_pa=900.0), SafeLevel.VENT),
        ("over_displacement", lambda r: replace(r, displacement_um=600.0), SafeLevel.VENT),
        ("device_silent", lambda r: None, SafeLevel.PUMP_OFF),
        ("watchdog_tripped", lambda r: replace(r, watchdog_tripped=True), SafeLevel.PUMP_OFF),
        ("board_fault", lambda r: replace(r, latched_faults=2), SafeLevel.PUMP_OFF),
        ("pump_mismatch", lambda r: replace(r, pump_fraction=0.9), SafeLevel.PUMP_OFF),
        ("pressure_missing", lambda r: replace(r, gauge_pressure_pa=math.nan), SafeLevel.RAMP_DOWN),
    ],
)
def test_each_latching_fault_enters_its_safe_level_within_two_ticks_of_its_window(
    name: str, change: Callable[[BenchReading], BenchReading | None], safe_level: SafeLevel
) -> None:
    run = Run(CALM, 60.0, after(25.0, math.inf, change))
    assert run.finished == Exit.SAFETY_TRIP
    latched = [f for f in run.of("fault") if f["latching"]]
    assert [f["name"] for f in latched] == [name]
    fault_s = latched[0]["mono_s"]
    entered = next(row for row in run.rows if row.safe_level == safe_level)
    assert entered.mono_s - fault_s <= 0.041
    if safe_level >= SafeLevel.PUMP_OFF:
        assert entered.pump_fraction == 0.0
    assert entered.vent_fraction == (1.0 if safe_level == SafeLevel.VENT else 0.0)


def test_a_frozen_sensor_is_detected_although_it_answers() -> None:
    frozen: list[BenchReading] = []

    def freeze(now_s: float, reading: BenchReading) -> BenchReading:
        if now_s < 25.0:
            frozen[:] = [reading]
            return reading
        return frozen[0]

    run = Run(CALM, 60.0, freeze)
    assert {"displacement_missing", "displacement_frozen"} & {f["name"] for f in run.of("fault")}
    assert run.finished == Exit.SAFETY_TRIP


def test_a_single_outlier_is_ignored() -> None:
    wild = after(25.0, 25.02, lambda r: replace(r, displacement_um=r.displacement_um + 300.0))
    run = Run(CALM, 40.0, wild)
    assert run.finished == Exit.DONE
    after_it = run.value("mono_s") > 25.0
    assert (
        np.max(np.abs(run.value("filtered_um")[after_it & (run.value("state") == State.HOLD)]))
        < 2.0
    )


def test_missing_sensors_never_start_the_pump() -> None:
    run = Run(CALM, 60.0, lambda now_s, r: replace(r, displacement_quality=3))
    assert run.finished == Exit.SAFETY_TRIP
    assert np.all(run.value("pump_fraction") == 0.0)
    fault = run.of("fault")[-1]
    assert fault["name"] == "overdue"
    assert "quality 3" in fault["seen"]


def test_an_error_in_the_control_code_stops_the_pump(monkeypatch: pytest.MonkeyPatch) -> None:
    from membrane_ctrl.controller import state_handlers

    def broken(context: TickContext) -> State:
        raise ZeroDivisionError("x / 0")

    monkeypatch.setitem(state_handlers.HANDLERS, State.HOLD, broken)
    run = Run()
    assert run.finished == Exit.SAFETY_TRIP
    assert [(f["name"], f["seen"]) for f in run.of("fault")] == [
        ("tick_error", "ZeroDivisionError: x / 0")
    ]
    first_error = 1 + next(i for i, row in enumerate(run.rows) if row.state == State.HOLD)
    assert np.all(run.value("pump_fraction")[first_error:] == 0.0)


def test_a_mirror_that_cannot_follow_its_setpoint_is_a_fault() -> None:
    config = CALM.model_copy(update={"limits": LimitsConfig(following_error_max_um=5.0)})
    moved = after(25.0, math.inf, lambda r: replace(r, displacement_um=r.displacement_um - 20.0))
    run = Run(config, 60.0, moved)
    assert [f["name"] for f in run.of("fault")] == ["following_error"]


@pytest.mark.campaign
def test_a_flat_mirror_is_inflated_within_hours_and_held() -> None:
    twin = TwinConfig(scenario="calm", laser_noise_um=0.3, from_flat=True)
    loop = LoopConfig(rate_hz=2.0, measurement_filter_s=0.25)
    limits = LimitsConfig(displacement_min_um=-40_000.0)
    run = Run(Config(twin=twin, loop=loop, limits=limits), 4.0 * 3600)
    assert run.states == ["check", "inflate", "settle", "hold", "lower"], run.of("fault")
    hold_s = run.of("state")[3]["mono_s"]
    assert 2.0 * 3600 < hold_s < 4.0 * 3600
    assert np.max(run.value("truth_displacement_um")) < 5.0  # no overshoot to speak of


def vent_stuck(reading: BenchReading) -> BenchReading:
    return replace(reading, displacement_um=-25.0 + 1e-3 * (reading.sample_counter % 7))


def test_a_film_that_does_not_respond_is_not_inflated() -> None:
    run = Run(CALM, 30.0, lambda now_s, r: vent_stuck(r))
    assert run.finished == Exit.SAFETY_TRIP
    assert [f["name"] for f in run.of("fault")] == ["actuator_test"]
    assert "vent" in run.of("fault")[0]["seen"]
    assert State.INFLATE not in run.value("state")


def test_the_same_seed_gives_the_same_run() -> None:
    config = Config(loop=LoopConfig(rate_hz=25.0))
    first, second = Run(config, 20.0), Run(config, 20.0)
    assert [row.pack() for row in first.rows] == [row.pack() for row in second.rows]
    assert first.events == second.events


@pytest.mark.parametrize("field", ["pump_fraction", "vent_fraction"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -0.1, 1.1])
def test_an_invalid_bench_command_counts_as_an_error_of_the_control_code(
    monkeypatch: pytest.MonkeyPatch, field: str, value: float
) -> None:
    from membrane_ctrl.controller import state_handlers

    def broken(context: TickContext) -> State:
        context.pump_fraction = 0.5
        setattr(context, field, value)
        return State.STANDBY

    monkeypatch.setitem(state_handlers.HANDLERS, State.STANDBY, broken)
    run = Run(CALM, 5.0)
    assert [f["name"] for f in run.of("fault")] == ["tick_error"]
    assert all(tick.outputs.command == BenchCommand(0.0, 0.0) for tick in run.ticks)


def test_an_error_in_a_vented_fault_leaves_the_vent_open(monkeypatch: pytest.MonkeyPatch) -> None:
    from membrane_ctrl.controller import state_handlers

    def broken(context: TickContext) -> State:
        raise ZeroDivisionError("x / 0")

    monkeypatch.setitem(state_handlers.HANDLERS, State.FAULT, broken)
    run = Run(CALM, 60.0, after(25.0, math.inf, lambda r: replace(r, gauge_pressure_pa=900.0)))
    assert run.finished == Exit.SAFETY_TRIP
    assert run.ticks[-1].outputs.command == BenchCommand(0.0, 1.0)
