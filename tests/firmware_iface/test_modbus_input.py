"""Interlock circuits at Modbus inputs, over TCP and RTU, against an emulated module."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import pytest_asyncio

from firmware_iface.drivers.modbus_input import ModbusInputs
from firmware_iface.emulators.input_module import InputModule
from firmware_iface.emulators.modbus_server import Answer, ModbusTcpServer
from firmware_iface.links.modbus_rtu import RtuBus, extract_reply, rtu_frame
from firmware_iface.links.modbus_tcp import GuardedModbusTcp
from firmware_iface.links.serial_port import SerialSettings
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError
from tests.support.virtual_time import run_virtual
from tests.worlds.faulty_devices import MemoryWire, RtuBusEmulator

BITS = [("discrete", 3), ("coil", 3), ("discrete", 11)]


class Rig:
    """A module whose circuits a test opens, behind a server."""

    def __init__(self) -> None:
        self.closed = {
            ("discrete", 3): True,
            ("coil", 3): True,
            ("discrete", 11): True,
            ("discrete", 4): False,
        }
        tables = {
            kind: {at: self._circuit(kind, at) for name, at in self.closed if name == kind}
            for kind in ("discrete", "coil")
        }
        self.module = InputModule(tables["discrete"], tables["coil"])
        self.spoil: bytes | None = None
        self.server = ModbusTcpServer(self._answer, "127.0.0.1", 0)

    def _circuit(self, kind: str, at: int):  # type: ignore[no-untyped-def]
        return lambda: self.closed[kind, at]

    def _answer(self, unit: int, pdu: bytes) -> Answer:
        return Answer(
            self.spoil
            if self.spoil is not None
            else self.module.respond(pdu) or bytes([pdu[0] | 128, 1])
        )

    def inputs(self) -> ModbusInputs:
        return ModbusInputs(GuardedModbusTcp("127.0.0.1", self.server.port, 1, 5.0), BITS)  # type: ignore[arg-type]


@pytest_asyncio.fixture
async def rig() -> AsyncIterator[Rig]:
    made = Rig()
    await made.server.start()
    yield made
    await made.server.stop()


async def test_closed_circuits_read_one_and_each_is_its_own(rig: Rig) -> None:
    inputs = rig.inputs()
    await inputs.open()
    assert await inputs.closed_circuits() == (True, True, True)
    for place, key in enumerate([("discrete", 3), ("coil", 3), ("discrete", 11)]):
        rig.closed[key] = False
        assert await inputs.closed_circuits() == tuple(at != place for at in range(3))
        rig.closed[key] = True
    await inputs.close()


async def test_a_module_without_its_supply_reads_open(rig: Rig) -> None:
    inputs = rig.inputs()
    await inputs.open()
    rig.module.powered = False
    assert await inputs.closed_circuits() == (False, False, False)
    await inputs.close()


@pytest.mark.parametrize(
    "pdu", [bytes([2, 2, 255, 255]), bytes([2, 0]), bytes([1, 1, 1]), bytes([2, 1, 1, 1])]
)
async def test_an_answer_of_another_length_or_function_is_an_error(rig: Rig, pdu: bytes) -> None:
    inputs = ModbusInputs(GuardedModbusTcp("127.0.0.1", rig.server.port, 1, 0.5), [("discrete", 3)])
    await inputs.open()
    rig.spoil = pdu
    with pytest.raises(LinkError):
        assert await inputs.closed_circuits() is None
    await inputs.close()


async def test_a_module_that_reports_a_failure_is_an_error_and_an_unknown_address_is_refused(
    rig: Rig,
) -> None:
    inputs = rig.inputs()
    await inputs.open()
    rig.module.broken = True
    with pytest.raises(LinkError, match="device failure"):
        await inputs.closed_circuits()
    rig.module.broken = False
    await inputs.close()
    elsewhere = ModbusInputs(
        GuardedModbusTcp("127.0.0.1", rig.server.port, 1, 5.0), [("discrete", 99)]
    )
    with pytest.raises(DeviceRefusedError, match="illegal address"):
        await elsewhere.open()
    await elsewhere.close()


async def test_a_module_that_is_not_there_is_named(unused_tcp_port: int) -> None:
    inputs = ModbusInputs(GuardedModbusTcp("127.0.0.1", unused_tcp_port, 1, 0.5), [("coil", 0)])
    with pytest.raises(LinkDownError, match=f"127.0.0.1:{unused_tcp_port}"):
        await inputs.open()
    assert inputs.describe() == {"port": f"tcp://127.0.0.1:{unused_tcp_port}", "register": "coil 0"}


def test_a_serial_bus_carries_bits_beside_registers() -> None:
    async def test() -> None:
        closed = {0: True, 7: False, 8: True}
        module = InputModule({at: (lambda at=at: closed[at]) for at in closed}, {2: lambda: True})
        slaves = {4: lambda pdu: module.respond(pdu) or bytes([pdu[0] | 128, 1])}
        bus = RtuBus(MemoryWire(RtuBusEmulator(SerialSettings(115_200), slaves)), quiet_s=0.05)
        device = bus.device(4, 0.05)
        inputs = ModbusInputs(
            device, [("discrete", 0), ("discrete", 7), ("discrete", 8), ("coil", 2)]
        )
        await inputs.open()
        assert await inputs.closed_circuits() == (True, False, True, True)
        with pytest.raises(DeviceRefusedError):
            await device.read_discrete(0, 9)
        await inputs.close()

    run_virtual(test())


def test_bits_over_rtu_are_in_the_standards_order() -> None:
    async def test() -> None:
        module = InputModule({at: (lambda at=at: at in (0, 9)) for at in range(10)}, {})
        bus = RtuBus(
            MemoryWire(
                RtuBusEmulator(SerialSettings(115_200), {1: lambda pdu: module.respond(pdu) or b""})
            ),
            0.05,
        )
        device = bus.device(1, 0.05)
        await device.connect()
        assert [at for at, bit in enumerate(await device.read_discrete(0, 10)) if bit] == [0, 9]
        await device.close()

    run_virtual(test())


def test_a_serial_answer_with_another_number_of_bytes_is_an_error() -> None:
    with pytest.raises(LinkError, match="2 bytes of bits instead of 1"):
        extract_reply(rtu_frame(1, bytes([2, 2, 1, 1])), 1, 2, 6, "reading")
    assert extract_reply(rtu_frame(1, bytes([2, 1, 1])), 1, 2, 6, "reading") == bytes([2, 1, 1])
