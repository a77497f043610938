"""The tables `[[devices.interlocks]]`: what they take, and what they refuse in one line."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from membrane_ctrl.config import reference
from membrane_ctrl.config.schema import INTERLOCKS_MAX, Config
from membrane_ctrl.config.toml_file import dump_toml, parse_tables
from membrane_ctrl.model.errors import InputError

DOOR = {"driver": "board_input", "name": "door", "text": "shut the door", "input": 0}


def parsed(*interlocks: dict[str, Any], board: str | None = "tcp://b") -> Config:
    devices: dict[str, Any] = {"interlocks": list(interlocks)}
    if board is not None:
        devices["board"] = board
    else:
        value = {"driver": "modbus_map", "link": "tcp://plc", "raw": [0, 1], "value": [0.0, 1.0]}
        places = {"displacement": 0, "pump": 1, "gauge_pressure": 2}
        devices |= {role: value | {"address": address} for role, address in places.items()}
    return parse_tables({"devices": devices}, Config, "lab.toml")


def test_a_door_stops_the_pump_unless_another_level_is_set() -> None:
    (door,) = parsed(DOOR).interlocks
    assert (door.name, door.safe_level) == ("door", "pump_off")
    (door,) = parsed(DOOR | {"safe_level": "vent"}).interlocks
    assert door.safe_level == "vent"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"safe_level": "hold_flow"}, "safe_level"),
        ({"name": "Emergency Stop"}, "name"),
        ({"text": ""}, "text"),
        ({"text": "two\nlines"}, "one line"),
        ({"text": "\u202eevil"}, "printable"),
        ({"input": 16}, "input"),
        ({"input": -1}, "input"),
        ({"driver": "board"}, "did you mean board_input?"),
        ({"inverted": True}, "unknown key"),
    ],
)
def test_a_wrong_table_is_one_line(change: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as caught:
        parsed(DOOR | change)
    assert words in str(caught.value)
    assert "devices.interlocks.0" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_two_interlocks_of_one_name_are_refused() -> None:
    with pytest.raises(InputError, match=r"interlocks\.1\.name.*'door'"):
        parsed(DOOR, DOOR | {"input": 1})


def test_an_input_of_the_board_needs_a_board() -> None:
    with pytest.raises(InputError, match=r"interlocks\.0\.driver.*no board"):
        parsed(DOOR, board=None)


def test_there_may_be_many_but_no_more_than_the_mask_has_bits() -> None:
    many = [
        {"driver": "gpio_line", "name": f"circuit_{line}", "text": "x", "line": line}
        for line in range(INTERLOCKS_MAX)
    ]
    assert len(parsed(*many).interlocks) == INTERLOCKS_MAX
    with pytest.raises(InputError, match="at most 32"):
        parsed(*many, many[0] | {"name": "one_more", "line": 99})


def test_a_written_file_is_read_back() -> None:
    config = parsed(
        DOOR,
        {"driver": "modbus_input", "name": "air", "text": "x", "link": "tcp://plc", "address": 3},
    )
    assert parse_tables(tomllib.loads(dump_toml(config)), Config, "lab.toml") == config


def test_config_explain_shows_the_table_as_a_list() -> None:
    (table,) = reference.find_explained("gpio_line")
    assert table.title == '[[devices.interlocks]] driver = "gpio_line"'
    assert {"name", "text", "safe_level", "wiring"} <= {key.name for key in table.keys}
