"""Events as lines of `events.jsonl` and back."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from membrane_ctrl.model.acquisition_events import Capture
from membrane_ctrl.model.event_base import Event, UnknownEvent
from membrane_ctrl.model.event_lines import KINDS, from_dict
from membrane_ctrl.model.events import (
    CommandTaken,
    Fault,
    FaultySensor,
    Plausibility,
    SensorsUsed,
    StateEntered,
)
from membrane_ctrl.model.port_events import CommanderChanged


def test_keys_stay_in_the_order_of_the_format() -> None:
    line = json.dumps(StateEntered("hold", "settle", "inside the band").to_dict())
    assert line == '{"kind": "state", "state": "hold", "from": "settle", "why": "inside the band"}'


def test_empty_fields_are_left_out_but_a_missing_commander_is_kept() -> None:
    assert CommandTaken("ack", "ann", "").to_dict() == {
        "kind": "command",
        "command": "ack",
        "who": "ann",
        "why": "",
    }
    assert Capture(3, failed="dark").to_dict() == {"kind": "capture", "cycle": 3, "failed": "dark"}
    assert CommanderChanged(None, "ann", "").to_dict() == {
        "kind": "commander",
        "who": None,
        "former": "ann",
        "why": "",
    }


@pytest.mark.parametrize("cls", KINDS.values())
def test_every_event_class_is_restored_from_its_line(cls: type[Event]) -> None:
    event = from_dict({"kind": cls.line_kind})
    assert type(event) is cls
    again = from_dict(json.loads(json.dumps(event.to_dict())))
    assert repr(again) == repr(event)


@pytest.mark.parametrize(
    "line",
    [
        {},
        {"kind": 3},
        {"kind": ["fault"]},
        {"kind": "of tomorrow", "x": 1},
        {"kind": "fault", "code": "x"},
        {"kind": "state", "state": None},
    ],
)
def test_unknown_event_lines_are_kept_unchanged(line: dict[str, Any]) -> None:
    event = from_dict(line)
    assert isinstance(event, UnknownEvent)
    assert event.to_dict() == line


def test_a_key_that_a_line_lacks_is_empty() -> None:
    fault = from_dict({"kind": "fault", "name": "late"})
    assert isinstance(fault, Fault)
    assert (fault.code, fault.remedy, fault.latching) == (0, "", False)
    silent = from_dict({"kind": "child_silent", "child": "screen"})
    assert math.isnan(silent.to_dict()["overdue_s"])


def test_the_numbers_of_an_event_do_not_depend_on_its_words() -> None:
    fault = Fault(21, "over", "deep", "501 µm", "limit", "vent", True, "look")
    assert fault.numbers() == (21.0, 1.0)
    assert Fault(21, "x", "y", "z", "", "", True, "").numbers() == fault.numbers()
    assert StateEntered("hold", "settle", "inside").numbers() == ()


def test_the_numbers_of_a_table_come_in_the_order_of_its_keys() -> None:
    one = CommandTaken(
        "gains", "ann", "", 60.0, loop={"ti_s": 2.0, "pump": {"scale": [1, 2]}, "name": "x"}
    )
    other = CommandTaken(
        "gains", "bob", "", 60.0, loop={"pump": {"scale": (1, 2)}, "name": "y", "ti_s": 2.0}
    )
    assert one.numbers() == other.numbers() == (60.0, 1.0, 2.0, 2.0)


def test_codes_come_back_as_their_class_and_count_among_the_numbers() -> None:
    event = from_dict({"kind": "plausibility", "faulty": "laser", "readings": "x"})
    assert isinstance(event, Plausibility)
    assert event.faulty is FaultySensor.LASER
    assert event.numbers() == (2.0,)
    assert json.loads(json.dumps(event.to_dict()))["faulty"] == "laser"
    assert isinstance(from_dict({"kind": "plausibility", "faulty": "of tomorrow"}), UnknownEvent)


def test_lists_are_restored_unchanged() -> None:
    held = SensorsUsed(("laser", "optics"), ("laser +12 µm",))
    assert from_dict(json.loads(json.dumps(held.to_dict()))) == held
    assert held.sentence == "The centre is estimated from laser, optics; jumped: laser +12 µm"
    for sensors in ("laser", [1], {"laser": 1}):
        assert isinstance(from_dict({"kind": "sensors_used", "sensors": sensors}), UnknownEvent)
