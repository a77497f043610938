"""Adapters that return what is sent, as RS-485 adapters with local echo do: named as such."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

import pytest

from firmware_iface.drivers.bronkhorst import BronkhorstFlow
from firmware_iface.drivers.bronkhorst_modbus import ModbusParameters
from firmware_iface.drivers.bronkhorst_propar import ProparParameters
from firmware_iface.drivers.keyence_dl_rs1a import KeyenceDlRs1a
from firmware_iface.drivers.mks_937b import Mks937b
from firmware_iface.drivers.modbus_map import ModbusValue, ValueMap
from firmware_iface.drivers.optoncdt1420 import Optoncdt1420
from firmware_iface.drivers.vaisala_ptb330 import VaisalaPtb330
from firmware_iface.drivers.ventus import Ventus
from firmware_iface.emulators.modbus_pdu import answer_request
from firmware_iface.emulators.pumps import BronkhorstRegisters, Instrument
from firmware_iface.links.modbus_rtu import RtuBus
from firmware_iface.links.serial_port import SerialSettings
from firmware_iface.roles import DeviceRefusedError, LinkError
from firmware_iface.settings import (
    KeyenceDlRs1aConfig,
    Mks937bConfig,
    Optoncdt1420Config,
    VaisalaPtb330Config,
    VentusConfig,
)
from tests.support.virtual_time import run_virtual
from tests.worlds.faulty_devices import (
    KeyenceDlRs1aEmulator,
    MemoryWire,
    Mks937bEmulator,
    Optoncdt1420Emulator,
    ProparDevice,
    RtuBusEmulator,
    SerialDevice,
    VaisalaPtb330Emulator,
    VentusEmulator,
)

LINE = SerialSettings(38_400)
PRESSURE = ValueMap(0, (0.0, 1000.0), (0.0, 1000.0), (0.0, 1000.0))
FLOW = Instrument("DMFC", "M1", 200.0, "mln/min", lambda: 0.0)


class Registers:
    """A gauge: 600 Pa in each register."""

    def read(self, address: int, count: int) -> list[int]:
        return [600] * count

    def write(self, address: int, words: Any) -> None:
        raise AssertionError("nothing is written to a gauge")


def gauge() -> tuple[SerialDevice, Any]:
    device = RtuBusEmulator(LINE, {1: partial(answer_request, table=Registers())})
    return device, ModbusValue(RtuBus(MemoryWire(device)).device(1, 0.1), PRESSURE)


def bronkhorst_rtu() -> tuple[SerialDevice, Any]:
    device = RtuBusEmulator(LINE, {3: partial(answer_request, table=BronkhorstRegisters(FLOW))})
    return device, BronkhorstFlow(ModbusParameters(RtuBus(MemoryWire(device)).device(3, 0.1)))


def bronkhorst_propar() -> tuple[SerialDevice, Any]:
    device = ProparDevice(FLOW, LINE)
    return device, BronkhorstFlow(ProparParameters(MemoryWire(device)))


def keyence() -> tuple[SerialDevice, Any]:
    device = KeyenceDlRs1aEmulator(lambda: 0.0)
    return device, KeyenceDlRs1a(KeyenceDlRs1aConfig(port="memory"), MemoryWire(device))


def mks() -> tuple[SerialDevice, Any]:
    device = Mks937bEmulator(lambda: 600.0)
    return device, Mks937b(Mks937bConfig(port="memory"), MemoryWire(device))


def vaisala() -> tuple[SerialDevice, Any]:
    device = VaisalaPtb330Emulator(lambda: 101_325.0)
    return device, VaisalaPtb330(VaisalaPtb330Config(port="memory"), MemoryWire(device))


def ventus() -> tuple[SerialDevice, Any]:
    device = VentusEmulator(lambda fraction: None)
    return device, Ventus(VentusConfig(port="memory"), MemoryWire(device))


def optoncdt() -> tuple[SerialDevice, Any]:
    device = Optoncdt1420Emulator(lambda: 12.0, noise_um=1.0)
    return device, Optoncdt1420(Optoncdt1420Config(port="memory"), MemoryWire(device))


MADE = [gauge, bronkhorst_rtu, bronkhorst_propar, keyence, mks, vaisala, ventus]


def refuse_to_open(device: SerialDevice, open_it: Callable[[], Awaitable[object]]) -> str:
    async def run() -> str:
        with pytest.raises(LinkError) as refused:
            await open_it()
        return str(refused.value)

    return run_virtual(run())


@pytest.mark.parametrize("make", MADE)
def test_an_echo_before_the_answer_is_named(
    make: Callable[[], tuple[SerialDevice, Any]],
) -> None:
    device, driver = make()
    device.faults.echo = True
    message = refuse_to_open(device, driver.open)
    assert "the adapter echoes what is sent" in message
    assert "baud" not in message


@pytest.mark.parametrize("make", [*MADE, optoncdt])
def test_an_echo_without_an_answer_is_named(
    make: Callable[[], tuple[SerialDevice, Any]],
) -> None:
    device, driver = make()
    device.faults.echo = device.faults.deaf = True
    assert "only what was sent comes back" in refuse_to_open(device, driver.open)


@pytest.mark.parametrize("make", MADE)
@pytest.mark.parametrize("fault", ["silent", "garbage_bytes", "none"])
def test_other_faults_are_no_echo(make: Callable[[], tuple[SerialDevice, Any]], fault: str) -> None:
    device, driver = make()

    async def run() -> str:
        if fault != "none":
            setattr(device.faults, fault, 9)
        try:
            await driver.open()
        except LinkError as error:
            return str(error)
        finally:
            await driver.close()
        return ""

    message = run_virtual(run())
    assert "echo" not in message.replace("echo test", "")
    assert bool(message) == (fault != "none")


def test_a_sensor_that_repeats_commands_itself_may_be_echoed() -> None:
    """The optoNCDT's answer may begin with the command; its stream needs no command."""

    async def run() -> float:
        device, driver = optoncdt()
        device.faults.echo = True
        await driver.open()
        sample = await driver.displacement()
        await driver.close()
        return float(sample.displacement_um)

    assert run_virtual(run()) == pytest.approx(12.0, abs=2.0)


def test_the_answer_to_a_write_may_equal_the_question() -> None:
    """Function 6: without an echo the answer is the question, and no fault."""

    async def run() -> None:
        words = [0, 0]

        class Table:
            def read(self, address: int, count: int) -> list[int]:
                return words[address : address + count]

            def write(self, address: int, new: Any) -> None:
                words[address : address + len(new)] = new

        device = RtuBusEmulator(LINE, {1: partial(answer_request, table=Table())})
        link = RtuBus(MemoryWire(device)).device(1, 0.1)
        await link.connect()
        await link.write_register(1, 7)
        assert words == [0, 7]
        device.faults.echo = True
        with pytest.raises(DeviceRefusedError, match="echoes"):
            await link.read_holding(0, 2)
        await link.close()

    run_virtual(run())
