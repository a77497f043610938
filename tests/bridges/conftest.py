"""What tests of several bridges share."""

from __future__ import annotations

import pytest

from membrane_ctrl.bridges import command_lanes

PATIENCE_S = 60.0  # a machine that runs the tests may pause for seconds


@pytest.fixture
def slow_answers_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """For a test that is not about the time in which the hold answers: the limits of commands are
    on the real clock.
    """
    monkeypatch.setattr(command_lanes, "TIME_LIMIT_S", PATIENCE_S)
    monkeypatch.setattr(command_lanes, "SAFETY_ANSWER_S", PATIENCE_S)
