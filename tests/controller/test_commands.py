"""Commands are refused with a reason before anything is done."""

from __future__ import annotations

import pytest

from membrane_ctrl.config.schema import Config, ShapeConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.commands import TABLE, explain_refusal
from membrane_ctrl.model.telemetry import State

WITHOUT_SHAPE = Config(shape=ShapeConfig(enabled=False))


@pytest.mark.parametrize("state", sorted(TABLE["capture"].states))
def test_a_capture_is_refused_where_nothing_measures(state: State) -> None:
    capture = Command("capture", "tester")
    assert "no shape measurement" in explain_refusal(capture, state, WITHOUT_SHAPE)
    assert explain_refusal(capture, state, Config()) == ""


@pytest.mark.parametrize("turned_deg", [361.0, -400.0, float("inf")])
def test_a_capture_of_an_impossible_turn_is_refused(turned_deg: float) -> None:
    capture = Command("capture", "tester", value=turned_deg)
    assert "at most 360" in explain_refusal(capture, State.HOLD, Config())


@pytest.mark.parametrize("state", sorted(set(State) - {State.STANDBY, State.FAULT}))
def test_an_ack_is_refused_without_a_latched_fault(state: State) -> None:
    assert "ack is not allowed" in explain_refusal(Command("ack", "anybody"), state, Config())
