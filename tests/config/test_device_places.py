"""Two roles on one register, channel, coil or line are refused; devices may be shared."""

from __future__ import annotations

from typing import Any

import pytest

from firmware_iface.drivers import bronkhorst, bronkhorst_modbus
from membrane_ctrl.config import device_places
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import parse_tables
from membrane_ctrl.instruments import bench
from membrane_ctrl.model.errors import InputError
from tests.worlds.role_tables import roles, value

Table = dict[str, Any]


def interlock(name: str, **keys: Any) -> Table:
    return {"name": name, "text": "x", **keys}


def refusal(tables: Table) -> str:
    with pytest.raises(InputError) as caught:
        parse_tables(tables, Config, "lab.toml")
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith("lab.toml: ")
    return line


BRONKHORST = {"driver": "bronkhorst_modbus", "link": "rtu:///dev/ttyUSB1", "unit_id": 3}
CASES = {
    "pump and gauge on one register": (
        roles(gauge_pressure=value("tcp://plc", 10)),
        "devices.pump.address",
        "devices.gauge_pressure.address",
    ),
    "the same link without its default port": (
        roles(gauge_pressure=value("tcp://PLC:502", 10)),
        "devices.pump.address",
        "devices.gauge_pressure.address",
    ),
    "one register of a 32-bit value": (
        roles(gauge_pressure=value("tcp://plc", 9, type="f32")),
        "devices.pump.address",
        "register 10",
    ),
    "a function that is the default and one that is written": (
        roles(gauge_pressure=value("tcp://plc", 10, function="holding")),
        "devices.pump.address",
        "devices.gauge",
    ),
    ("pump and vent"): (
        roles(vent=value("tcp://plc", 10)),
        "devices.pump.address",
        "devices.vent.address",
    ),
    "two sensors": (
        roles(barometer=value("tcp://plc", 5), thermometer=value("tcp://plc", 5)),
        "devices.barometer.address",
        "devices.thermometer.address",
    ),
    "one instrument as pump and gauge": (
        roles(pump=BRONKHORST, gauge_pressure=BRONKHORST),
        "devices.pump.unit_id",
        "devices.gauge_pressure.unit_id",
    ),
    "a gauge on the setpoint of a flow controller": (
        roles(pump=BRONKHORST, gauge_pressure=value("rtu:///dev/ttyUSB1", 0x21, unit_id=3)),
        "devices.pump.unit_id",
        "devices.gauge_pressure.address",
    ),
    "a preset's registers": (
        roles(
            pump=value("tcp://plc", 2, preset="waveshare_ao8"),
            vent=value("tcp://plc", 2, preset="waveshare_ao8"),
        ),
        "devices.pump.address",
        "devices.vent.address",
    ),
    "two interlocks on one input of the board": (
        {
            "devices": {
                "board": "tcp://b",
                "interlocks": [
                    interlock("door", driver="board_input", input=4),
                    interlock("stop", driver="board_input", input=4),
                ],
            }
        },
        "devices.interlocks.0.input",
        "devices.interlocks.1.input",
    ),
    "two interlocks on one coil": (
        {
            "devices": {
                "board": "tcp://b",
                "interlocks": [
                    interlock(
                        "door", driver="modbus_input", link="tcp://plc", function="coil", address=4
                    ),
                    interlock(
                        "stop",
                        driver="modbus_input",
                        link="tcp://plc:502",
                        function="coil",
                        address=4,
                    ),
                ],
            }
        },
        "devices.interlocks.0.address",
        "devices.interlocks.1.address",
    ),
    "two interlocks on one line": (
        {
            "devices": {
                "board": "tcp://b",
                "interlocks": [
                    interlock("door", driver="gpio_line", line=4),
                    interlock("stop", driver="gpio_line", line=4),
                ],
            }
        },
        "devices.interlocks.0.line",
        "devices.interlocks.1.line",
    ),
    "one serial port of two instruments": (
        roles(
            gauge_pressure={"driver": "mks_937b", "port": "/dev/ttyUSB0", "channel": 1},
            displacement={"driver": "optoncdt1420", "port": "/dev/ttyUSB0"},
        ),
        "displacement",
        "gauge_pressure",
    ),
    "the board's serial line with other settings for an interlock": (
        {
            "devices": {
                "board": "rtu:///dev/ttyUSB0?baud=115200",
                "interlocks": [
                    interlock(
                        "door",
                        driver="modbus_input",
                        link="rtu:///dev/ttyUSB0?baud=9600",
                        address=4,
                    ),
                ],
            }
        },
        "board",
        "interlocks.0",
    ),
}


@pytest.mark.parametrize(("tables", "one", "other"), CASES.values(), ids=CASES.keys())
def test_two_roles_on_one_place_are_refused_in_one_line_that_names_both(
    tables: Table, one: str, other: str
) -> None:
    line = refusal(tables)
    assert one in line
    assert other in line


SOUND = {
    "different registers of one unit": roles(
        vent=value("tcp://plc", 11), barometer=value("tcp://plc", 12)
    ),
    "the same address of two units": roles(vent=value("tcp://plc", 10, unit_id=2)),
    "the same address of two hosts": roles(vent=value("tcp://other", 10)),
    "an input register and a holding register": roles(
        vent=value("tcp://plc", 10, function="input")
    ),
    "two instruments on one line": roles(
        pump=BRONKHORST, gauge_pressure=BRONKHORST | {"unit_id": 5}
    ),
    "another register of a flow controller": roles(
        pump=BRONKHORST, thermometer=value("rtu:///dev/ttyUSB1", 0xA138, unit_id=3, type="f32")
    ),
    "an identity register that several roles check": roles(
        pump=value("tcp://plc", 10, identity_address=99, identity_equals=7),
        vent=value("tcp://plc", 11, identity_address=99, identity_equals=7),
    ),
    "a coil and a discrete input of one address": {
        "devices": {
            "board": "tcp://b",
            "interlocks": [
                interlock("a", driver="modbus_input", link="tcp://plc", function="coil", address=4),
                interlock("b", driver="modbus_input", link="tcp://plc", address=4),
                interlock("c", driver="gpio_line", line=4),
                interlock("d", driver="gpio_line", line=4, chip="/dev/gpiochip1"),
                interlock("e", driver="board_input", input=4),
            ],
        }
    },
    "an interlock on the line of the pump": roles(
        pump=BRONKHORST, gauge_pressure=BRONKHORST | {"unit_id": 5}
    )
    | {},
}


@pytest.mark.parametrize("tables", SOUND.values(), ids=SOUND.keys())
def test_devices_may_be_shared(tables: Table) -> None:
    parse_tables(tables, Config, "lab.toml")


def test_at_the_start_two_names_of_one_host_are_one_device() -> None:
    config = parse_tables(
        roles(pump=value("tcp://localhost", 10), vent=value("tcp://127.0.0.2", 10)),
        Config,
        "lab.toml",
    )
    assert config.devices is not None
    with pytest.raises(InputError, match=r"devices\.pump\.address and devices\.vent\.address"):
        bench.make_bench(config.devices)


def test_the_registers_of_a_bronkhorst_are_those_of_its_driver() -> None:
    used = (bronkhorst.MEASURE, bronkhorst.SETPOINT, bronkhorst.CONTROL_MODE, bronkhorst.FMEASURE)
    for parameter in used:
        address, _ = bronkhorst_modbus.register_of(parameter)
        assert address in device_places._BRONKHORST_REGISTERS
