from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def fast_port(monkeypatch: pytest.MonkeyPatch) -> None:
    """No pauses: tests of them do not wait in real time."""
    monkeypatch.setattr("membrane_ctrl.control_port.endpoint._PAUSE_S", 0.0)
    monkeypatch.setattr("membrane_ctrl.control_port.request_intake._PAUSE_S", 0.0)
