from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def fast_port(monkeypatch: pytest.MonkeyPatch) -> None:
    """No pauses: what they are for is not tested by waiting for them."""
    monkeypatch.setattr("membrane_ctrl.control_port.endpoint._PAUSE_S", 0.0)
    monkeypatch.setattr("membrane_ctrl.control_port.session._PAUSE_S", 0.0)
