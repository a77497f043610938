from __future__ import annotations

import json
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.control_port.protocol import (
    MESSAGE_BYTES,
    TEXT_BYTES,
    WHO_BYTES,
    WHY_BYTES,
    Errand,
    Request,
    RequestError,
    encode,
    parse,
)
from membrane_ctrl.control_port.sender import Peer, explain_missing_role
from membrane_ctrl.controller.command import Kind
from membrane_ctrl.controller.commands import TABLE
from membrane_ctrl.hold.child_processes import EVENT_BYTES
from membrane_ctrl.model.events import CommandTaken

ACTIONS = (*TABLE, *get_args(Errand))


def line(**request: object) -> bytes:
    return json.dumps(request).encode()


def test_every_command_of_the_table_can_be_asked() -> None:
    more: dict[str, dict[str, object]] = {
        "setpoint": {"value": 1},
        "manual": {"value": 0.5},
        "mark": {"text": "door"},
        "gains": {"loop": {"kp_per_s": 0.5, "feedforward_barometer": False}},
        "tune": {"experiment": {"kind": "relay"}},
    }
    assert set(get_args(Kind)) == set(TABLE)
    for kind in TABLE:
        assert parse(line(do=kind, number=3, **more.get(kind, {}))).do == kind


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (b"", "invalid JSON"),
        (b"\n", "invalid JSON"),
        (b"[]", "input should be an object"),
        (b'"stop"', "input should be an object"),
        (b"\xff\xfe{}", "invalid JSON"),
        (b'{"do": "stop"', "invalid JSON"),
        (b"[" * 4000, "invalid JSON"),
        (b"{}", "do: missing"),
        (line(do="explode"), "do: input should be 'hold', 'stop'"),
        (line(do="stop", colour="red"), "colour: unknown key"),
        (line(do="stop", value=1.0), "stop takes no value"),
        (line(do="setpoint"), "value missing"),
        (line(do="setpoint", value="5"), "value: '5': write a number"),
        (line(do="setpoint", value=True), "value: true is neither a number"),
        (b'{"do": "setpoint", "value": NaN}', "finite"),
        (b'{"do": "setpoint", "value": 1e999}', "finite"),
        (line(do="mark"), "text missing"),
        (line(do="mark", text="x" * 501), "longer than 500 bytes"),
        (line(do="mark", text="a\nb"), "printable"),
        (b'{"do": "mark", "text": "\\ud800"}', "invalid JSON"),
        (line(do="stop", why="y" * 301), "longer than 300 bytes"),
        (line(do="gains"), "loop missing"),
        (line(do="gains", loop={"kp_per_s": "much"}), "loop.kp_per_s"),
        (line(do="setpoint", value=1.0, pump={}), "setpoint takes no pump"),
        (line(do="stop", number=-1), "number"),
        (line(do="stop", number=10**30), "number"),
        (line(do="watch", period_s=0.0), "period_s"),
    ],
)
def test_what_is_no_request_is_refused_in_one_line(message: bytes, expected: str) -> None:
    with pytest.raises(RequestError) as refused:
        parse(message)
    assert expected in str(refused.value)
    assert str(refused.value).isprintable()


def test_a_wrong_request_is_answered_by_its_number() -> None:
    with pytest.raises(RequestError) as refused:
        parse(line(do="explode", number=7))
    assert refused.value.number == 7


def test_the_longest_words_fit_an_event() -> None:
    """As JSON, in an event with everything else that a command's event holds."""
    worst = "\U0001f9ca"
    request = parse(line(do="mark", text=worst * (TEXT_BYTES // 4), why=worst * (WHY_BYTES // 4)))
    who = "é" * (WHO_BYTES // 2)
    event = {
        "time_utc": "2026-11-21T03:10:06.819914+00:00",
        "mono_s": 1234567.123456,
        "kind": "command",
        "command": "mark",
        "who": who,
        "why": request.why,
        "text": request.text,
        "value": 1.2345678901234567e-300,
        "refused": "r" * 400,
    }
    assert len(json.dumps(event)) < EVENT_BYTES


def test_the_longest_pump_map_fits_a_message_and_an_event() -> None:
    third = 1 / 3
    steps = [{"fraction": third, "duration_s": 100 + third, "until_um": -29 - third}] * 90
    around = {
        "holding_flow_um_per_s": 10 * third,
        "laser_um": third,
        "gain": third,
        "limit_um": 10 * third,
    }
    spec = ExperimentSpec.model_validate(
        {"kind": "pump_map", "duration_s": 1000 * third, "steps": steps, **around}
    )
    message = encode(
        {"number": 2**53 - 1, "do": "tune", "why": "y" * WHY_BYTES, "experiment": spec.model_dump()}
    )
    assert len(message) < MESSAGE_BYTES
    assert ExperimentSpec.model_validate(parse(message).experiment) == spec
    who, why = "é" * (WHO_BYTES // 2), "\U0001f9ca" * (WHY_BYTES // 4)
    event = CommandTaken("tune", who, why, experiment=spec.model_dump(), refused="r" * 400)
    stamp = {"time_utc": "2026-11-21T03:10:06.819914+00:00", "mono_s": 1234567.123456}
    assert len(json.dumps(stamp | event.to_dict())) < EVENT_BYTES


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=8,
)
fields = st.dictionaries(st.sampled_from([*Request.model_fields, "other"]), values, max_size=6)


def outcome(data: bytes) -> str:
    """The requested action, or why there is none."""
    try:
        return parse(data).do
    except RequestError as refused:
        return str(refused)


@given(st.binary(max_size=MESSAGE_BYTES) | fields.map(lambda d: json.dumps(d).encode()))
def test_any_bytes_are_a_request_or_a_refusal(data: bytes) -> None:
    answer = outcome(data)
    assert answer in ACTIONS or (0 < len(answer) <= 300 and answer.isprintable())


def test_every_action_takes_a_role() -> None:
    reader, tuner = Peer("unix:r", "read"), Peer("unix:t", "tune")
    readable = {action for action in ACTIONS if not explain_missing_role(reader, action)}  # type: ignore[arg-type]
    assert readable == {"status", "watch"}
    assert not any(explain_missing_role(tuner, action) for action in ACTIONS)  # type: ignore[arg-type]
