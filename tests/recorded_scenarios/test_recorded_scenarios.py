"""Thirty recorded scenarios: the controller decides in each as it did when it was recorded."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.controller.safety import RULES
from membrane_ctrl.model.telemetry import SafeLevel, ShapeState, State
from tests.recorded_scenarios.recording import find_differences, read_expected, run_scenario
from tests.recorded_scenarios.scenarios import SCENARIOS

EXPECTED, BIT_BY_BIT = read_expected()


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_controller_decides_as_recorded(name: str) -> None:
    found = run_scenario(SCENARIOS[name])
    differences = find_differences(EXPECTED[name], found, BIT_BY_BIT)
    assert differences == [], (
        "if the change is wanted: python -m tests.recorded_scenarios.recording"
    )


def test_there_are_thirty_scenarios_and_a_recording_of_each() -> None:
    assert len(SCENARIOS) == 30
    assert EXPECTED.keys() == SCENARIOS.keys()


_BY_LINK = ("no_answer", "watchdog_by_link", "link_slow")


def test_the_scenarios_reach_all_states_and_all_rules_that_a_bench_can_trip() -> None:
    codes = np.concatenate([recording["codes"] for recording in EXPECTED.values()])
    states, shape_states, safe_levels, faults = (set(codes[:, column]) for column in range(4))
    assert states == set(State)
    assert shape_states == set(ShapeState)
    assert safe_levels == set(SafeLevel)
    tick_error = 50  # needs a defect of the program
    # need a link that takes time: tests/hold/test_link_faults.py
    by_link = {rule.code for rule in RULES.values() if rule.name in _BY_LINK}
    assert faults == {0, *RULES} - {tick_error} - by_link


def test_a_difference_in_the_last_bit_is_found_on_the_recording_processor_only() -> None:
    recording = EXPECTED["setpoint ramps"]
    commands = recording["commands"].copy()
    commands[200, 0] = np.nextafter(commands[200, 0], 1.0)
    changed = recording | {"commands": commands}
    assert find_differences(recording, recording, bit_by_bit=True) == []
    assert find_differences(recording, changed, bit_by_bit=False) == []
    (difference,) = find_differences(recording, changed, bit_by_bit=True)
    assert difference.startswith("commands: item 200 is")


def test_another_code_is_found_on_every_processor() -> None:
    recording = EXPECTED["laser lost for good"]
    codes = recording["codes"].copy()
    codes[300, 2] += 1
    (difference,) = find_differences(recording, recording | {"codes": codes}, bit_by_bit=False)
    assert difference.startswith("codes: item 300 is")
