"""Events as sentences."""

from __future__ import annotations

import pytest

from membrane_ctrl.model import prose
from membrane_ctrl.model.event_base import Event, EventLine
from membrane_ctrl.model.event_lines import KINDS, from_dict

FAULT = {
    "time_utc": "x",
    "mono_s": 1.0,
    "kind": "fault",
    "code": 21,
    "name": "over_displacement",
    "seen": "501.0 µm",
    "cause": "the bowl is deeper than its limit",
    "limit": "limits.displacement_max_um",
    "safe_level": "vent",
    "latching": True,
    "remedy": "check the laser against a ruler",
    "crc32": "0",
}


def test_a_fault_states_its_cause_place_and_remedy() -> None:
    assert from_dict(FAULT).sentence == (
        "Fault over_displacement: the bowl is deeper than its limit (501.0 µm). Do: check "
        "the laser against a ruler. "
        "Limit: limits.displacement_max_um; safe level vent"
    )


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ({"kind": "end", "exit": "done"}, "Run ended: done"),
        ({"kind": "why", "why": "inside +-2 µm"}, "Inside ±2 µm"),
        (
            {"kind": "state", "state": "hold", "from": "settle", "why": ""},
            "State hold, from settle",
        ),
        (
            {"kind": "command", "command": "setpoint", "value": 5.0, "who": "ann", "why": "step"},
            "Command setpoint 5 µm by ann: step",
        ),
        (
            {"kind": "command", "command": "hold", "who": "ann", "refused": "not now"},
            "Command hold by ann. Refused: not now",
        ),
        (
            {"kind": "command", "command": "mark", "text": "a [b] {c}", "who": "ann"},
            'Command mark "a [b] {c}" by ann',
        ),
        ({"kind": "no_claim", "message": "the board\ncannot"}, "The board cannot"),
        (
            {"kind": "plausibility", "faulty": "none", "readings": "laser +1.0 µm"},
            "Laser and camera agree again (laser +1.0 µm)",
        ),
        # not as expected: the fields, whatever they are
        (
            {"kind": "state", "to": "hold", "error_um": 1 / 3, "why": None},
            "state: to hold, error_um 0.333333",
        ),
        (
            {"kind": "command", "command": "setpoint", "value": "much"},
            "command: command setpoint, value much",
        ),
        ({"kind": "of_tomorrow"}, "of_tomorrow"),
        ({}, "?"),
    ],
)
def test_an_event_is_a_sentence(line: EventLine, message: str) -> None:
    assert from_dict(line).sentence == message


@pytest.mark.parametrize("cls", KINDS.values(), ids=KINDS)
def test_every_sentence_uses_the_fields_and_properties_of_its_event(cls: type[Event]) -> None:
    keys = {key for _, key in cls.keys}
    for name in prose.fields_of(cls._template):
        assert name in keys or isinstance(getattr(cls, name, None), property), name


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (FAULT, "ERROR"),
        ({"kind": "acquisition", "state": "failed"}, "ERROR"),
        ({"kind": "acquisition", "state": "retrying"}, "WARN"),
        ({"kind": "link", "up": False}, "WARN"),
        ({"kind": "link", "up": True}, "INFO"),
        ({"kind": "plausibility", "faulty": "laser"}, "WARN"),
        ({"kind": "plausibility", "faulty": "none"}, "INFO"),
        ({"kind": "command", "command": "hold", "refused": "no"}, "WARN"),
        ({"kind": "state"}, "INFO"),
    ],
)
def test_levels(line: EventLine, expected: str) -> None:
    assert from_dict(line).level == expected
