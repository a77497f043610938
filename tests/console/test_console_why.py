"""The one line."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from console_feed import HOLDING

from membrane_ctrl.config.schema import Config
from membrane_ctrl.console.why import explain_state, list_used_sensors
from membrane_ctrl.model.telemetry import SafeLevel, State, TelemetryRow

CONFIG = Config()


def line(expected: str = "", fault: str = "", **changes: float) -> str:
    return explain_state(replace(HOLDING, **changes), expected, fault, CONFIG)


def test_hold_names_the_terms_of_the_flow_largest_first() -> None:
    assert line() == "pump gives 1.14 µm/s: +1.24 integral, -0.11 feed-forward"
    assert line(p_um_per_s=-2.0, flow_um_per_s=0.0) == (
        "pump is at 0: -2.00 proportional, +1.24 integral, -0.11 feed-forward"
    )


def test_settle_is_named() -> None:
    assert line(state=State.SETTLE).startswith("settling: pump gives 1.14 µm/s")


@pytest.mark.parametrize(
    ("target_um", "flow_um_per_s", "message"),
    [
        (25.0, 5.3, "pump gives 5.30 µm/s: filling, 24.9 µm to go"),
        (-25.0, 0.0, "pump is at 0: waiting for the leak, 25.1 µm to go"),
    ],
)
def test_inflate_states_the_remaining_distance(
    target_um: float, flow_um_per_s: float, message: str
) -> None:
    assert line(state=State.INFLATE, target_um=target_um, flow_um_per_s=flow_um_per_s) == message


def test_outside_the_band_the_direction_and_the_response_are_named() -> None:
    assert line(error_um=-6.9, flow_um_per_s=0.0) == (
        "outside the band: bowl 6.9 µm too deep, pump is at 0, only the leak can lower it"
    )
    assert line(error_um=6.9, flow_um_per_s=5.3, flow_wanted_um_per_s=9.0) == (
        "outside the band: bowl 6.9 µm too shallow, pump gives 5.30 µm/s, its limit"
    )
    assert line(error_um=2.0) == line(error_um=0.0)  # the edge is inside


def test_a_safe_level_names_its_fault() -> None:
    assert (
        line(safe_level=SafeLevel.VENT, fault="over pressure")
        == "pump is off and the vent is open: over pressure"
    )
    assert line(safe_level=SafeLevel.HOLD_FLOW, expected="laser is back soon").endswith(
        "laser is back soon"
    )
    assert line(safe_level=SafeLevel.PUMP_OFF) == "pump is off: unknown fault"


VALUE = {"driver": "modbus_map", "link": "tcp://plc", "raw": [0, 1], "value": [0.0, 1.0]}
NO_VENT = Config.model_validate(
    {
        "devices": {
            r: VALUE | {"address": n}
            for n, r in enumerate(("displacement", "pump", "gauge_pressure"))
        }
    }
)
WITH_VENT = Config.model_validate(
    {"devices": {**NO_VENT.devices.model_dump(exclude_none=True), "vent": VALUE | {"address": 9}}}  # type: ignore[union-attr]
)


def test_a_bench_without_a_vent_never_shows_an_open_vent() -> None:
    row = replace(
        HOLDING, safe_level=SafeLevel.VENT, vent_fraction=1.0, vent_readback_fraction=math.nan
    )
    reason = explain_state(row, "", "over pressure", NO_VENT)
    assert reason == "pump is off; no vent is fitted, the leak lowers the mirror: over pressure"
    assert (
        explain_state(row, "", "over pressure", WITH_VENT)
        == "pump is off and the vent is open: over pressure"
    )


@pytest.mark.parametrize(
    ("readback", "open_"), [(1.0, True), (0.5, True), (0.49, False), (0.0, False)]
)
def test_a_vent_whose_read_back_contradicts_its_command_is_not_shown_as_open(
    readback: float, open_: bool
) -> None:
    reason = line(
        safe_level=SafeLevel.VENT, vent_fraction=1.0, vent_readback_fraction=readback, fault="x"
    )
    assert reason.startswith("pump is off and the vent is open") == open_
    if not open_:
        assert f"commanded open, but its read-back is {100 * readback:.0f}" in reason


def test_without_a_reading_the_pump_keeps_its_flow() -> None:
    reason = "pump keeps its last mean flow: no valid laser reading"
    assert line(displacement_um=math.nan) == reason
    assert (
        line(state=State.INFLATE, filtered_um=math.nan) == reason
    )  # nothing has been filtered yet


@pytest.mark.parametrize(
    "state", [State.STANDBY, State.CHECK, State.LOWER, State.FAULT, State.MANUAL, State.TUNE]
)
def test_other_states_show_the_controllers_reason_or_a_fixed_text(state: State) -> None:
    assert line(state=state, expected="waiting for the gauge") == "waiting for the gauge"
    assert line(state=state).startswith("pump is ")


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("safe_level", SafeLevel)
def test_there_is_always_a_line(state: State, safe_level: SafeLevel) -> None:
    empty = replace(
        TelemetryRow(*[math.nan] * 35), state=state, safe_level=safe_level, flow_um_per_s=0.0
    )
    reason = explain_state(empty, "", "", CONFIG)
    assert "pump" in reason
    assert "nan" not in reason


def test_the_sensors_that_hold_the_mirror_are_named_with_their_shares() -> None:
    row = replace(
        HOLDING,
        estimate_sigma_um=0.02,
        optics_share=0.93,
        laser_innovation=-0.4,
        optics_innovation=0.1,
    )
    assert list_used_sensors(row) == "laser 7 %, optics 93 %"
    assert list_used_sensors(
        replace(row, laser_innovation=math.nan, optics_share=1.0, barometer_innovation=0.0)
    ) == ("optics 100 %, barometer")
    assert (
        list_used_sensors(replace(row, laser_innovation=math.nan, optics_innovation=math.nan))
        == "nothing"
    )


def test_a_mirror_held_by_the_optics_alone_is_not_called_unheld() -> None:
    assert "mean flow" in line(displacement_um=math.nan)
    assert "mean flow" not in line(displacement_um=math.nan, estimate_sigma_um=0.02)
