"""`check` lists each interlock with its present state, and refuses or warns of what cannot work."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import AsyncIterator
from typing import Any

import pytest
import pytest_asyncio

from firmware_iface import register_map
from firmware_iface.emulators.gpio import EmulatedGpio
from firmware_iface.emulators.input_module import InputModule
from firmware_iface.emulators.modbus_server import Answer, ModbusTcpServer
from firmware_iface.emulators.pump_board import BoardSample, PumpBoardEmulator
from firmware_iface.roles import BenchIdentity
from membrane_ctrl.commissioning.check import check_config
from membrane_ctrl.commissioning.interlock_check import (
    HOW_TO_TEST,
    describe_effect,
    probe_interlocks,
)
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import parse_tables
from membrane_ctrl.controller.cross_check import cross_check
from membrane_ctrl.model.errors import DeviceError, FindingsError, InputError
from tests.worlds.role_tables import roles

MAP_3 = BenchIdentity("board", 3, "1.1.0", 0.5, 800.0, 1.0, interlocks_fitted=0xFFFF)
MAP_2 = BenchIdentity("board", 2, "1.0.0", 0.5, 800.0, 1.0)
DOOR = {"driver": "board_input", "name": "door", "text": "shut the door", "input": 3}
AIR = {
    "driver": "modbus_input",
    "name": "air",
    "text": "leave the room",
    "link": "tcp://plc",
    "address": 3,
}
STOP = {"driver": "gpio_line", "name": "stop", "text": "pull the button", "line": 5}


class Plant:
    """A mirror that does not move, with interlock inputs."""

    def __init__(self) -> None:
        self.inputs = 0xFFFF
        self.samples = 0

    def sample(self) -> BoardSample:
        self.samples += 1
        return BoardSample(0.0, 0, 600.0, 101_325.0, 22.5, 23.0, self.samples, 0.0, self.inputs)

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        assert pump_fraction == 0.0


class Rig:
    """A board, a module and GPIO lines."""

    def __init__(self) -> None:
        self.plant = Plant()
        self.board = PumpBoardEmulator(self.plant)
        self.air_closed = True
        self.module = InputModule({3: lambda: self.air_closed}, {})
        self.server = ModbusTcpServer(
            lambda unit, pdu: Answer(self.module.respond(pdu) or b""), "127.0.0.1", 0
        )
        self.gpio = EmulatedGpio({("/dev/gpiochip0", 5): "closed"})

    @property
    def config(self) -> Config:
        air = AIR | {
            "link": f"tcp://127.0.0.1:{self.server.port}",
            "timeout_s": 1.0,
            "age_max_s": 2.0,
        }
        devices = {
            "board": f"tcp://127.0.0.1:{self.board.port}",
            "timeout_s": 0.4,
            "interlocks": [DOOR, air, STOP],
        }
        return parse_tables({"devices": devices}, Config, "lab.toml")


@pytest_asyncio.fixture
async def rig(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Rig]:
    made = Rig()
    monkeypatch.setitem(sys.modules, "gpiod", made.gpio)
    await made.board.start()
    await made.server.start()
    yield made
    await made.board.stop()
    await made.server.stop()


async def states(rig: Rig) -> dict[str, str]:
    assert rig.config.devices is not None
    return {probe.name: probe.state for probe in await probe_interlocks(rig.config.devices)}


async def test_each_circuit_is_listed_as_it_is_now(rig: Rig) -> None:
    assert await states(rig) == {"door": "closed", "air": "closed", "stop": "closed"}
    rig.plant.inputs = 0xFFFF & ~(1 << 3)
    rig.air_closed = False
    rig.gpio.contacts["/dev/gpiochip0", 5] = "cut"
    assert await states(rig) == {"door": "open", "air": "open", "stop": "open"}


async def test_a_signal_that_is_lost_is_named_and_does_not_hide_the_others(rig: Rig) -> None:
    rig.module.broken = True
    rig.gpio.failing = OSError(19, "No such device")
    assert rig.config.devices is not None
    probes = await probe_interlocks(rig.config.devices)
    assert [probe.state for probe in probes] == ["closed", "no signal", "no signal"]
    assert "device failure" in probes[1].problem
    assert "/dev/gpiochip0" in probes[2].problem
    assert (
        describe_effect(probes)
        == "no hold before they are closed: air (no signal), stop (no signal)"
    )


async def test_the_command_lists_them_and_asks_for_a_test(
    rig: Rig, capsys: pytest.CaptureFixture[str]
) -> None:
    rig.air_closed = False
    await asyncio.to_thread(check_config, rig.config, "lab.toml", False)
    output = " ".join(capsys.readouterr().out.split())
    assert " ".join(HOW_TO_TEST.split()) in output
    await asyncio.to_thread(check_config, rig.config, "lab.toml", True)
    report = json.loads(capsys.readouterr().out)
    assert [(one["name"], one["state"], one["safe_level"]) for one in report["interlocks"]] == [
        ("door", "closed", "pump_off"),
        ("air", "open", "pump_off"),
        ("stop", "closed", "pump_off"),
    ]
    assert report["interlocks"][0]["source"] == "input 3 of the pump board"
    assert report["would"]["interlocks"] == "no hold before they are closed: air (open)"


async def test_a_lost_signal_is_an_error_after_the_report(
    rig: Rig, capsys: pytest.CaptureFixture[str]
) -> None:
    rig.module.broken = True
    with pytest.raises(DeviceError, match=r"interlock air: .*device failure"):
        await asyncio.to_thread(check_config, rig.config, "lab.toml", True)
    assert json.loads(capsys.readouterr().out)["interlocks"][1]["state"] == "no signal"


async def test_inputs_of_a_board_of_an_earlier_map_are_refused(rig: Rig) -> None:
    board = PumpBoardEmulator(rig.plant, registers=register_map.list_known_maps()[2])
    await board.start()
    config = parse_tables(
        {
            "devices": {
                "board": f"tcp://127.0.0.1:{board.port}",
                "timeout_s": 0.4,
                "interlocks": [DOOR],
            }
        },
        Config,
        "lab.toml",
    )
    with pytest.raises(FindingsError) as caught:
        await asyncio.to_thread(check_config, config, "lab.toml", True)
    assert "devices.interlocks.0.input = 3: this board has register map 2" in str(caught.value)
    await board.stop()


def test_a_missing_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", None)
    config = parse_tables(
        {"devices": {"board": "tcp://b", "interlocks": [STOP]}}, Config, "lab.toml"
    )
    assert config.devices is not None
    with pytest.raises(InputError, match=r"devices\.interlocks\.0: .*membrane-ctrl\[gpio\]"):
        asyncio.run(probe_interlocks(config.devices))


def findings(
    board: BenchIdentity | None = None, without_board: bool = False, **change: Any
) -> dict[str, str]:
    """Fields of findings on one interlock, with their severity."""
    table = {**(AIR if "driver" not in change else {}), **change}
    tables = roles() if without_board else {"devices": {"board": "tcp://b"}}
    tables["devices"]["interlocks"] = [table]
    prefix = "devices.interlocks.0."
    found = cross_check(parse_tables(tables, Config, "lab.toml"), board)
    return {
        one.field.removeprefix(prefix): one.severity
        for one in found
        if one.field.startswith(prefix)
    }


def test_a_sound_source_gives_no_finding() -> None:
    assert findings() == {}
    assert findings(MAP_3, **DOOR) == {}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"age_max_s": 0.3}, {"age_max_s": "error"}),  # 0.1 s and a time-out of 0.2 s
        ({"age_max_s": 2.1}, {"age_max_s": "error"}),
        ({"age_max_s": 2.0}, {}),
        ({"period_s": 0.21}, {"period_s": "warning"}),
        ({"period_s": 0.2}, {}),
        ({"function": "coil"}, {"function": "warning"}),
        ({"safe_level": "vent"}, {}),
    ],
)
def test_a_source_that_reacts_too_late_or_cannot_be_trusted(
    change: dict[str, Any], expected: dict[str, str]
) -> None:
    assert findings(**change) == expected


def test_a_level_that_needs_a_vent_is_warned_of_on_a_bench_without_one() -> None:
    assert findings(without_board=True, safe_level="vent") == {"safe_level": "warning"}
    assert findings(without_board=True, safe_level="pump_off") == {}


def test_the_boards_map_and_its_own_guard_are_judged() -> None:
    assert findings(MAP_2, **DOOR) == {"input": "error"}
    unguarded = BenchIdentity("board", 3, "1.1.0", 0.5, 800.0, 1.0, interlocks_fitted=0b0111)
    assert findings(unguarded, **DOOR) == {"input": "warning"}
    assert findings(None, **DOOR) == {}
    assert findings(MAP_2) == {}  # another source


def test_a_module_on_the_pumps_serial_line_is_warned_of_and_counted_among_its_answers() -> None:
    line = "rtu:///dev/ttyUSB0?baud=115200"
    tables: dict[str, Any] = roles(pump={"driver": "bronkhorst_modbus", "link": line, "unit_id": 3})
    tables["devices"]["interlocks"] = [
        AIR | {"link": line, "unit_id": 9, "timeout_s": 0.3, "age_max_s": 1.0}
    ]
    found = {
        one.field: one.severity for one in cross_check(parse_tables(tables, Config, "lab.toml"))
    }
    assert found["devices.interlocks.0.link"] == "warning"
    assert found["devices.pump.timeout_s"] == "error"  # 0.2 s and 0.3 s before the watchdog's 0.5 s
