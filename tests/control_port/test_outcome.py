"""What became of a command, by the hold's answer."""

from __future__ import annotations

from typing import Any

import pytest

from membrane_ctrl.control_port.outcome import Outcome


@pytest.mark.parametrize(
    ("answer", "text", "done"),
    [
        ({"ok": True}, "lock: done", True),
        ({"ok": True, "problem": ""}, "lock: done", True),
        (
            {"ok": True, "problem": "disk full"},
            "lock: not stored, valid in this run only: disk full",
            False,
        ),
        ({"ok": False, "refused": "not now: done"}, "lock refused: not now: done", False),
        ({}, "lock refused: None", False),
    ],
)
def test_only_the_hold_decides_whether_it_is_done(
    answer: dict[str, Any], text: str, done: bool
) -> None:
    assert Outcome.from_answer("lock", answer) == Outcome("lock", text, done)
