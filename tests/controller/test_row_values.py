"""The values of a row belong to its own tick: computed in every state, or NaN, never repeated."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from membrane_ctrl.model.telemetry import State, TelemetryRow
from tests.support.scenario import CheckedScenario, play

SEEN = ("filtered_um", "leak_um_per_s")


@pytest.fixture(scope="module")
def rows() -> list[TelemetryRow]:
    """Held, paused while the leak grows, without light, by hand, held again, lowered."""
    at = [
        {"time_s": 25.0, "command": "pause"},
        {"time_s": 26.0, "event": "leak", "value": 1.5},
        {"time_s": 36.0, "command": "resume"},
        {"time_s": 50.0, "wrong": "no_light", "for_s": 5.0},
        {"time_s": 70.0, "command": "manual", "value": 1.5},
        {"time_s": 75.0, "wrong": "no_light", "for_s": 0.3},
        {"time_s": 80.0, "command": "hold"},
        {"time_s": 100.0, "command": "lower"},
    ]
    about = {
        "title": "rows",
        "duration_s": 110.0,
        "config": {"loop": {"rate_hz": 10.0}},
        "at": at,
        "expect": {},
    }
    return [tick.row for tick in play(CheckedScenario.model_validate(about)).ticks]


def between(rows: list[TelemetryRow], start_s: float, end_s: float) -> list[TelemetryRow]:
    return [row for row in rows if start_s <= row.mono_s < end_s]


def test_a_pause_shows_the_present_error(rows: list[TelemetryRow]) -> None:
    paused = between(rows, 25.2, 35.9)
    assert all(row.error_um == pytest.approx(row.setpoint_um - row.filtered_um) for row in paused)
    moved_um = paused[-1].truth_displacement_um - paused[0].truth_displacement_um
    assert abs(moved_um) > 2.0
    assert paused[-1].error_um - paused[0].error_um == pytest.approx(-moved_um, abs=1.5)


def test_values_that_are_not_computed_are_nan(rows: list[TelemetryRow]) -> None:
    for row in rows:
        if math.isnan(row.displacement_um):
            assert all(math.isnan(getattr(row, name)) for name in (*SEEN, "error_um"))
        if State(row.state) in (State.MANUAL, State.TUNE, State.STANDBY, State.LOWER, State.FAULT):
            assert math.isnan(row.error_um)
    assert any(math.isnan(row.displacement_um) and row.state == State.HOLD for row in rows)
    assert any(row.state == State.MANUAL for row in rows)


@pytest.mark.parametrize("name", ["error_um", *SEEN])
def test_no_value_is_repeated_from_the_tick_before(rows: list[TelemetryRow], name: str) -> None:
    values = [getattr(row, name) for row in rows]
    assert not [row for row, (a, b) in zip(rows, pairwise(values), strict=False) if a == b]
