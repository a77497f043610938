"""The pump board on a serial line: our driver, and a plain client of another library."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path

import pytest
from counting_plant import CountingPlant, ManualClock
from pymodbus.client import ModbusSerialClient

from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.emulators.modbus_pdu import answer_request
from firmware_iface.emulators.serial_device import PtyWire
from firmware_iface.links.serial_port import SerialSettings
from firmware_iface.register_map import load_default_map
from firmware_iface.roles import BenchCommand, LinkDownError
from tests.worlds.faulty_board import PumpBoardEmulator
from tests.worlds.faulty_devices import RtuBusEmulator

SETTINGS = SerialSettings(115_200, parity="E")


@pytest.fixture
async def wire(board: PumpBoardEmulator, tmp_path: Path) -> AsyncIterator[PtyWire]:
    made = PtyWire(
        RtuBusEmulator(SETTINGS, {1: partial(answer_request, table=board.state)}), tmp_path / "tty"
    )
    made.plug()
    yield made
    made.unplug()


def url(wire: PtyWire) -> str:
    return f"rtu://{wire.path}?baud=115200&parity=E"


async def test_the_driver_works_over_rtu_as_over_tcp(
    wire: PtyWire, board: PumpBoardEmulator
) -> None:
    driver = PumpBoard(url(wire), timeout_s=20.0)
    identity = await driver.open()
    assert (identity.kind, identity.watchdog_s) == ("membrane pump board", 0.5)
    await driver.write(BenchCommand(0.125, 0.5))
    assert (board.state.pump_fraction, board.state.vent_fraction) == (0.125, 0.5)
    reading = await driver.read()
    assert (reading.pump_fraction, reading.vent_fraction) == (0.125, 0.5)
    assert reading.displacement_um == pytest.approx(
        CountingPlant.displacement_um(reading.sample_counter), abs=1e-3
    )
    await driver.write(BenchCommand(0.0, 0.0))
    await driver.close()
    assert board.state.read(49, 1) == [0]


async def test_a_pulled_cable_is_a_lost_link_and_its_watchdog_acts(
    wire: PtyWire, board: PumpBoardEmulator, plant: CountingPlant, clock: ManualClock
) -> None:
    driver = PumpBoard(url(wire), timeout_s=20.0, watchdog_s=0.5)
    await driver.open()
    await driver.write(BenchCommand(0.5, 0.0))
    wire.unplug()
    with pytest.raises(LinkDownError):
        await driver.read()
    clock.now_s += 0.6
    await plant.reaches((0.0, 0.0))
    await driver.close()


async def test_a_plain_pymodbus_client_reads_and_writes_the_board(
    wire: PtyWire, board: PumpBoardEmulator
) -> None:
    block = load_default_map().block("identity")

    def plain() -> tuple[list[int], bool, bool]:
        client = ModbusSerialClient(
            str(wire.path), baudrate=115_200, timeout=20
        )  # a pty has no parity
        assert client.connect()
        try:
            words = client.read_holding_registers(
                block.address, count=block.count, device_id=1
            ).registers
            claimed = client.write_registers(48, [500, 1, 0, 7, 0x1234, 0x5678], device_id=1)
            written = client.write_registers(56, [6250, 25_000, 7, 0x1234, 0x5678], device_id=1)
            refused = client.write_registers(56, [50_001, 0, 8, 0x1234, 0x5678], device_id=1)
            return words, claimed.isError() or written.isError(), refused.isError()
        finally:
            client.close()

    words, failed, refused = await asyncio.to_thread(plain)
    assert block.decode(words)["device_kind"] == load_default_map().device_kind
    assert not failed
    assert refused
    assert (board.state.pump_fraction, board.state.vent_fraction) == (0.125, 0.5)
