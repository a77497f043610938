"""The protection table is complete, names existing rules, and no bound depends on the failed
sensor.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest

import membrane_ctrl
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import load_toml
from membrane_ctrl.control.climate_allowance import HOUR_MOST_UM, MINUTES_MOST_UM
from membrane_ctrl.controller.duties import Activity, Duty, FilmSensor, Guard, ProcessValue
from membrane_ctrl.controller.protection import Failure, find_bound, find_protections
from membrane_ctrl.controller.safety import TABLE
from membrane_ctrl.controller.state_sets import MOVING

RULES = {rule.name: rule for rule in TABLE}
CELLS = list(product(ProcessValue, Activity, Duty))
# Two sensors against one need a third sensor and a film near its working point; excess gas a mirror
# held long.
NOT_EVERYWHERE = {Duty.MAJORITY, Duty.GAS}


def test_every_state_in_which_the_pump_may_run_has_a_row() -> None:
    assert {activity.state for activity in Activity} == MOVING


@pytest.mark.parametrize(("value", "activity", "duty"), CELLS, ids=lambda part: part.name.lower())
def test_every_protection_goal_has_a_rule_that_applies_in_its_state(
    value: ProcessValue, activity: Activity, duty: Duty
) -> None:
    protections = find_protections(value, activity, duty)
    assert protections or duty in NOT_EVERYWHERE
    for protection in protections:
        if not isinstance(protection, Guard):
            assert activity.state in RULES[protection].states, protection


def test_every_guard_appears_in_the_table() -> None:
    named = {
        protection
        for cell in CELLS
        for protection in find_protections(*cell)
        if isinstance(protection, Guard)
    }
    assert named == set(Guard)


@pytest.mark.parametrize(
    ("value", "failed", "failure"), list(product(ProcessValue, FilmSensor, Failure))
)
def test_a_failed_sensor_is_bounded_by_another_one(
    value: ProcessValue, failed: FilmSensor, failure: Failure
) -> None:
    if value is ProcessValue.OPTICS and failed is FilmSensor.LASER:
        return  # no laser is used
    bound = find_bound(value, failed, failure, Config())
    assert bound.sensor is not failed
    assert bound.sensor is not FilmSensor.LASER or value is not ProcessValue.OPTICS
    assert 0.0 < bound.distance_um < 2855.0  # where the pressure limit would end it


def test_sensors_of_the_climate_widen_the_bound_by_what_they_may_explain() -> None:
    example = Path(membrane_ctrl.__file__).parent / "examples" / "all-modbus-tcp.toml"
    bench = load_toml(example, Config)
    assert bench.devices is not None
    hygrometer = bench.devices.displacement
    devices = bench.devices.model_copy(update={"hygrometer": hygrometer})
    wider = bench.model_copy(update={"devices": devices})
    asked = (ProcessValue.LASER, FilmSensor.LASER)
    for failure, by_um in (
        (Failure.LOST, 0.0),
        (Failure.STEP, MINUTES_MOST_UM),
        (Failure.DRIFT, 3.0 * HOUR_MOST_UM),
        (Failure.DRIFT_WITHIN_CLIMATE, 0.0),
    ):
        plain = find_bound(*asked, failure, bench, laser_and_optics=False)
        bound = find_bound(*asked, failure, wider, laser_and_optics=False)
        assert bound.distance_um - plain.distance_um == pytest.approx(by_um)
