"""The register map: what it refuses, and that values survive conversion to registers and back."""

from __future__ import annotations

import copy
import math
import struct
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_iface.register_map import (
    DEFAULT_PATH,
    I32_NO_VALUE,
    RegisterMapError,
    list_known_maps,
    load_default_map,
    load_map,
    parse_map,
)


@pytest.fixture
def table() -> dict[str, Any]:
    return tomllib.loads(DEFAULT_PATH.read_text(encoding="utf-8"))


def test_sensor_and_command_blocks_are_one_transaction_each() -> None:
    registers = load_default_map()
    for name in ("identity", "sensors", "settings", "command"):
        block = registers.block(name)
        addresses = [
            at
            for register in block.registers
            for at in range(register.address, register.address + register.words)
        ]
        assert addresses == list(range(block.address, block.address + block.count))


def test_an_earlier_map_is_the_newest_without_what_came_later() -> None:
    newest, second, first = load_default_map(), list_known_maps()[2], list_known_maps()[1]
    assert (newest.map_version, second.map_version, first.map_version) == (3, 2, 1)
    assert [register for register in newest if register.since <= 2] == list(second)
    assert [fault.name for fault in second.faults] == ["watchdog", "over_pressure", "stopped"]
    assert [(block.address, block.count) for block in second.blocks[:2]] == [(0, 7), (16, 25)]
    assert [register for register in newest if register.since == 1] == list(first)
    assert [(block.address, block.count) for block in first.blocks] == [
        (0, 7),
        (16, 22),
        (48, 2),
        (56, 3),
        (64, 1),
    ]
    for version in (0, 4):
        with pytest.raises(RegisterMapError, match=f"map version {version} is none of"):
            newest.of_version(version)


def test_resolutions_are_finer_than_the_sensors() -> None:
    registers = load_default_map()
    assert 1 / registers.register("displacement_um").counts_per_unit <= 0.001
    assert 1 / registers.register("gauge_pressure_pa").counts_per_unit <= 0.01
    assert 1 / registers.register("ambient_pressure_pa").counts_per_unit <= 0.01
    assert 1 / registers.register("air_temperature_c").counts_per_unit <= 0.001


@settings(derandomize=True, deadline=None, max_examples=200)
@given(
    st.floats(-2.1e6, 2.1e6), st.floats(-2.1e6, 2.1e6), st.floats(0, 1), st.integers(0, 2**32 - 1)
)
def test_values_survive_to_half_a_count(
    displacement_um: float, pressure_pa: float, pump: float, counter: int
) -> None:
    block = load_default_map().block("sensors")
    sent = dict.fromkeys((register.name for register in block.registers), 0.0)
    sent |= {
        "displacement_um": displacement_um,
        "gauge_pressure_pa": pressure_pa,
        "pump_readback_fraction": pump,
        "sample_counter": counter,
    }
    got = block.decode(block.encode(sent))
    for register in block.registers:
        assert abs(got[register.name] - sent[register.name]) <= 0.5000001 / register.counts_per_unit


def test_big_word_comes_first() -> None:
    block = load_default_map().block("sensors")
    values = dict.fromkeys((register.name for register in block.registers), 0.0)
    words = block.encode(values | {"sample_counter": 0x00010002, "displacement_um": -0.001})
    assert words[:2] == [1, 2]
    assert words[6:8] == [0xFFFF, 0xFFFF]  # -1 nm


def test_f32_registers_are_ieee() -> None:
    block = load_default_map().block("identity")
    values = dict.fromkeys((register.name for register in block.registers), 0.0) | {
        "gauge_pressure_limit_pa": 812.5
    }
    words = block.encode(values)
    assert struct.unpack(">f", struct.pack(">2H", *words[4:6])) == (812.5,)
    assert block.decode(words)["gauge_pressure_limit_pa"] == 812.5


def test_a_missing_value_is_nan_on_both_sides() -> None:
    register = load_default_map().register("displacement_um")
    assert register.to_raw(math.nan) == I32_NO_VALUE
    assert math.isnan(register.to_value(I32_NO_VALUE))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("displacement_um", 2147483.648),
        ("displacement_um", -2147483.648),
        ("pump_readback_fraction", 1.5),
        ("heartbeat", math.nan),
    ],
)
def test_a_value_that_does_not_fit_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        load_default_map().register(name).to_raw(value)


def test_a_block_of_wrong_length_is_refused() -> None:
    with pytest.raises(ValueError, match="command has 5 registers, not 2"):
        load_default_map().block("command").decode([0, 0])


def _edit(table: dict[str, Any], block: int, register: int, **changes: Any) -> dict[str, Any]:
    edited = copy.deepcopy(table)
    entry = edited["block"][block]["registers"][register]
    entry |= changes
    for key in [key for key, value in entry.items() if value is None]:
        del entry[key]
    return edited


@pytest.mark.parametrize(
    ("block", "register", "changes", "message"),
    [
        (0, 1, {"address": 0}, "map_version .* overlaps device_kind"),
        (0, 3, {"address": 3}, "gauge_pressure_limit_pa .* overlaps firmware_version"),
        (2, 0, {"address": 8}, "gap between watchdog_period_s and watchdog_arm"),
        (3, 2, {"address": 60}, "gap between vent_command_fraction and heartbeat"),
        (5, 0, {"address": 20}, "stop .* comes after clear_key"),
        (0, 0, {"type": "u8"}, "device_kind: type 'u8' is none of u16, u32, i32, f32"),
        (1, 4, {"unit": "furlong"}, "displacement_um: unit 'furlong'"),
        (1, 4, {"name": "displacement"}, "displacement: the name must end in _um"),
        (1, 4, {"scale": 3}, "displacement_um: unknown key scale"),
        (1, 4, {"counts_per_unit": 0}, "displacement_um: counts_per_unit must be above 0"),
        (0, 3, {"counts_per_unit": 10}, "gauge_pressure_limit_pa: counts_per_unit"),
        (3, 0, {"max": None}, "pump_command_fraction: a rw register needs min <= max"),
        (3, 0, {"max": 2.0}, "pump_command_fraction: a limit is out of its type"),
        (1, 4, {"min": 0, "max": 1}, "displacement_um: .* a ro one has no limits"),
        (4, 0, {"address": 65536}, "clear_faults: address 65536 is outside"),
        (1, 17, {"since": 4}, "interlock_inputs: since must be a map version, 1..3"),
        (1, 0, {"since": 2}, "device_time_s is older than sample_counter before it"),
        (3, 0, {"meaning": None}, "pump_command_fraction: meaning is missing"),
        (
            3,
            2,
            {"name": "vent_command_fraction", "unit": "fraction"},
            "vent_command_fraction is there twice",
        ),
    ],
)
def test_a_wrong_register_is_named(
    table: dict[str, Any], block: int, register: int, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(RegisterMapError, match=message):
        parse_map(_edit(table, block, register, **changes))


def test_a_wrong_frame_of_the_map_is_named(table: dict[str, Any]) -> None:
    with pytest.raises(RegisterMapError, match="schema is 'other'"):
        parse_map(table | {"schema": "other"})
    with pytest.raises(RegisterMapError, match="map_version is missing"):
        parse_map({key: value for key, value in table.items() if key != "map_version"})
    with pytest.raises(RegisterMapError, match="block identity: access is 'w'"):
        parse_map(table | {"block": [table["block"][0] | {"access": "w"}]})
    with pytest.raises(RegisterMapError, match="block identity has no registers"):
        parse_map(table | {"block": [table["block"][0] | {"registers": []}]})
    with pytest.raises(RegisterMapError, match="fault bits"):
        parse_map(table | {"fault": [table["fault"][0], table["fault"][0]]})


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(RegisterMapError, match=r"nowhere\.toml"):
        load_map(tmp_path / "nowhere.toml")
    broken = tmp_path / "broken.toml"
    broken.write_text("schema = ", encoding="utf-8")
    with pytest.raises(RegisterMapError, match=r"broken\.toml"):
        load_map(broken)


def test_a_block_longer_than_a_transaction_is_refused(table: dict[str, Any]) -> None:
    many = [
        {"name": f"spare{i}", "address": 100 + i, "type": "u16", "meaning": "spare"}
        for i in range(126)
    ]
    spare = {"name": "spare", "access": "ro", "meaning": "spare", "registers": many}
    with pytest.raises(RegisterMapError, match="block spare has 126 words"):
        parse_map(table | {"block": [*table["block"], spare]})
