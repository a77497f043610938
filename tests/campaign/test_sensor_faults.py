"""Lying sensors, judged by the plant: the worst in every test run, all of them in the campaign."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from sensor_faults import FAULTS, PAIRS, SensorFault, blocked, drift, run_faults, scaled, stuck
from sensor_quiet import quiet_hours

from membrane_ctrl.config.schema import LimitsConfig
from membrane_ctrl.model.telemetry import State

NOISE_ONLY = SensorFault("gauge", "shows only noise", blocked(0.5))


def creep(um_per_s: float) -> SensorFault:
    return SensorFault("laser", f"drifts by {um_per_s} µm/s", drift(um_per_s), lasts_s=400.0)


@pytest.mark.parametrize(
    ("faults", "camera", "noticed", "most_um"),
    [
        ((SensorFault("gauge", "stuck", stuck), creep(-2.0)), False, "gauge_stuck", 60.0),
        ((creep(-2.0),), False, "laser_gauge_apart", 60.0),
        ((creep(-0.2),), False, "laser_gauge_apart", 60.0),
        ((NOISE_ONLY, creep(-2.0)), False, "gas_excess", 350.0),
    ],
)
def test_a_laser_that_creeps_leads_the_mirror_no_further_than_this(
    faults: Sequence[SensorFault], camera: bool, noticed: str, most_um: float
) -> None:
    story = run_faults(faults, 1, camera, from_start=False)
    assert story.noticed == noticed
    assert story.ended_in == State.FAULT
    assert story.pumped_um < most_um


def test_a_camera_outvoted_by_two_faulty_sensors_prevails_when_the_gas_agrees_with_it() -> None:
    story = run_faults((NOISE_ONLY, creep(-2.0)), 1, camera=True, from_start=False)
    assert story.noticed == "sensors: optics"
    assert story.ended_in == State.FAULT
    assert story.pumped_um < 350.0


@pytest.mark.parametrize("by", [10.0, 0.1, -1.0])
def test_a_gauge_in_another_unit_keeps_the_mirror_down_from_the_start(by: float) -> None:
    story = run_faults(
        (SensorFault("gauge", f"times {by}", scaled(by), lasts_s=30.0),), 1, False, from_start=True
    )
    assert story.ended_in == State.FAULT
    assert story.noticed in {"laser_gauge_apart", "over_pressure"}


@pytest.mark.parametrize("other_world", [False, pytest.param(True, marks=pytest.mark.campaign)])
def test_an_hour_of_everything_that_is_no_fault_of_a_sensor_is_held(other_world: bool) -> None:
    assert quiet_hours(4, other_world, 0.5).alarms == ()


@pytest.mark.campaign
@pytest.mark.timeout(900)
@pytest.mark.parametrize("seed", [2])
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: f"{fault.sensor} {fault.failure}")
@pytest.mark.parametrize("camera", [False, True])
def test_one_sensor_alone_never_leads_the_mirror_to_its_limits(
    fault: SensorFault, camera: bool, seed: int
) -> None:
    story = run_faults((fault,), seed, camera, from_start=False)
    limits = LimitsConfig()
    assert story.pumped_um < 200.0
    assert story.pressure_max_pa < limits.gauge_pressure_max_pa


@pytest.mark.campaign
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "faults", PAIRS[:2], ids=lambda faults: " and ".join(f.failure for f in faults)
)
@pytest.mark.parametrize("seed", [2, 3])
def test_two_at_once_are_found_before_the_limits(faults: Sequence[SensorFault], seed: int) -> None:
    story = run_faults(faults, seed, camera=False, from_start=False)
    assert story.ended_in == State.FAULT
    assert story.pumped_um < LimitsConfig().displacement_max_um


@pytest.mark.campaign
@pytest.mark.timeout(900)
@pytest.mark.parametrize("seed", range(60, 64))
@pytest.mark.parametrize("other_world", [False, True])
def test_a_night_without_a_fault_of_a_sensor_is_held(seed: int, other_world: bool) -> None:
    assert quiet_hours(seed, other_world, 3.0).alarms == ()
