"""The safe levels: their times, which an intermittent cause does not extend."""

from __future__ import annotations

import pytest

from membrane_ctrl.config.schema import StatesConfig
from membrane_ctrl.controller.safe_levels import SafeLevels
from membrane_ctrl.model.telemetry import SafeLevel

CONFIG = StatesConfig(hold_flow_max_s=10.0, ramp_down_s=5.0, pump_off_max_s=100.0)


def test_each_safe_level_escalates_to_the_next_after_its_time() -> None:
    levels = SafeLevels(CONFIG)
    levels.enter(SafeLevel.HOLD_FLOW, 50.0)
    times_s = (60.0, 60.5, 65.5, 66.0, 166.0, 166.5, 1e6)
    safe_levels = [levels.step(now_s) for now_s in times_s]
    assert [safe_level.name for safe_level in safe_levels] == [
        "HOLD_FLOW",
        "RAMP_DOWN",
        "RAMP_DOWN",
        "PUMP_OFF",
        "PUMP_OFF",
        "VENT",
        "VENT",
    ]


def test_a_milder_safe_level_is_not_entered() -> None:
    levels = SafeLevels(CONFIG)
    levels.enter(SafeLevel.PUMP_OFF, 0.0)
    levels.enter(SafeLevel.HOLD_FLOW, 1.0)
    assert levels.step(1.0) == SafeLevel.PUMP_OFF
    assert levels.age_s(1.0) == 1.0


@pytest.mark.parametrize(
    ("clear_s", "left_s"), [(0.5, 2.5), (6.0, 8.0), (8.0, 10.0), (1000.0, 10.0)]
)
def test_the_time_of_hold_flow_recovers_as_slowly_as_it_was_used(
    clear_s: float, left_s: float
) -> None:
    levels = SafeLevels(CONFIG)
    levels.enter(SafeLevel.HOLD_FLOW, 0.0)
    levels.clear(8.0)
    again_s = 8.0 + clear_s
    levels.enter(SafeLevel.HOLD_FLOW, again_s)
    assert levels.step(again_s + left_s) == SafeLevel.HOLD_FLOW
    assert levels.step(again_s + left_s + 0.01) == SafeLevel.RAMP_DOWN


def test_after_an_acknowledged_fault_the_full_time_is_available() -> None:
    levels = SafeLevels(CONFIG)
    levels.enter(SafeLevel.HOLD_FLOW, 0.0)
    levels.clear(9.0)
    levels.enter(SafeLevel.PUMP_OFF, 9.5)
    levels.leave()
    levels.enter(SafeLevel.HOLD_FLOW, 10.0)
    assert levels.step(19.9) == SafeLevel.HOLD_FLOW
