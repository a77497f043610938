"""The twin stands for every source of the configured interlocks."""

from __future__ import annotations

import contextlib
from typing import Any

import pytest

from firmware_iface.emulators.pump_board import BoardSample
from firmware_iface.roles import BenchReading
from firmware_iface.settings import BoardInputConfig, ModbusInputConfig
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.instruments.bench import make_bench
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sim import twin_process
from membrane_ctrl.sim.lab import Lab
from membrane_ctrl.sim.virtual_interlocks import VirtualInterlocks
from tests.worlds.role_tables import roles

SOURCES: list[dict[str, Any]] = [
    {"driver": "board_input", "name": "door", "text": "x", "safe_level": "vent", "input": 9},
    {"driver": "modbus_input", "name": "air", "text": "y", "link": "tcp://plc", "address": 3},
    {"driver": "gpio_line", "name": "stop", "text": "z", "line": 4},
]


class Still:
    """A plant at rest, with interlock inputs."""

    inputs = 0xFFFF

    def __init__(self) -> None:
        self.samples = 0

    def sample(self) -> BoardSample:
        self.samples += 1
        return BoardSample(
            0.0, 0, 600.0, 101325.0, 23.0, 21.0, self.samples, 0.01 * self.samples, self.inputs
        )

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        assert pump_fraction == 0.0


async def reading_of(devices: DevicesConfig) -> BenchReading:
    made = make_bench(devices)
    await made.open()
    try:
        return await made.read()
    finally:
        await made.close()


def patient(tables: dict[str, Any]) -> dict[str, Any]:
    return tables | (
        {"timeout_s": 2.0, "age_max_s": 5.0} if tables["driver"] == "modbus_input" else {}
    )


@pytest.mark.parametrize("open_input", [False, True])
async def test_the_emulated_lab_answers_for_each_source(open_input: bool) -> None:
    devices = DevicesConfig.model_validate(
        {
            "board": "tcp://b",
            "timeout_s": 2.0,
            "watchdog_s": 2.0,
            "interlocks": [patient(each) for each in SOURCES],
        }
    )
    plant = Still()
    if open_input:
        plant.inputs = 0xFFFF & ~(1 << 9)
    lab = Lab(plant, devices)
    try:
        moved = await lab.start()
        kinds = [type(interlock) for interlock in moved.interlocks]
        assert kinds == [
            BoardInputConfig,
            ModbusInputConfig,
            ModbusInputConfig,
        ]  # no machine has the GPIO line
        assert [interlock.name for interlock in moved.interlocks] == ["door", "air", "stop"]
        assert (await reading_of(moved)).interlocks_open == int(open_input)
    finally:
        await lab.stop()


async def test_single_instruments_have_interlocks_as_well() -> None:
    tables = roles()["devices"] | {
        "interlocks": [patient(SOURCES[1]), SOURCES[2]],
        "watchdog_s": 2.0,
    }
    for role in ("displacement", "pump", "gauge_pressure"):
        tables[role] |= {
            "timeout_s": 2.0,
            "type": "f32",
            "limits": [0.0, 1.0] if role == "pump" else [-1e4, 7e4],
        }
    lab = Lab(Still(), DevicesConfig.model_validate(tables))
    try:
        moved = await lab.start()
        assert (await reading_of(moved)).interlocks_open == 0
    finally:
        await lab.stop()


def test_the_twins_board_takes_the_place_of_every_source_in_order() -> None:
    config = Config.model_validate({"devices": {"board": "tcp://b", "interlocks": SOURCES}})
    moved = twin_process._at_board_inputs(config.interlocks)
    assert [(one.name, one.text, one.safe_level) for one in moved] == [
        ("door", "x", "vent"),
        ("air", "y", "pump_off"),
        ("stop", "z", "pump_off"),
    ]
    assert [one.input for one in moved if isinstance(one, BoardInputConfig)] == [0, 1, 2]


def test_more_than_the_twins_board_has_inputs_are_refused() -> None:
    many = [
        {"driver": "gpio_line", "name": f"n{line}", "text": "x", "line": line} for line in range(17)
    ]
    config = Config.model_validate({"devices": {"board": "tcp://b", "interlocks": many}})
    with (
        contextlib.ExitStack() as stack,
        pytest.raises(InputError, match="17 of them; the twin's pump board has 16"),
    ):
        twin_process.TwinProcess.start_twin(config, RunClock.start(), stack)


def test_virtual_circuits_open_and_lose_their_signals_as_their_sources_do() -> None:
    config = Config.model_validate({"devices": {"board": "tcp://b", "interlocks": SOURCES}})
    circuits = VirtualInterlocks(config.interlocks)

    def mask(now_s: float) -> int:
        circuits.advance(now_s)
        return circuits.open_mask(circuits.board_word(0xFFFF), now_s)

    assert mask(0.0) == 0
    circuits.open_names = {"door", "stop"}
    assert mask(0.1) == 0b101
    circuits.open_names = set()
    circuits.lost_names = {"door", "air"}
    assert mask(0.2) == 0b001
    assert mask(0.6) == 0b001
    assert mask(0.7) == 0b011
    circuits.lost_names = set()
    assert mask(0.8) == 0
