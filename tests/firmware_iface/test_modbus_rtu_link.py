"""Modbus RTU: frames byte by byte, and answers that are late, wrong, incomplete or missing. In
virtual time.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable, Coroutine, Sequence
from functools import partial
from typing import Any

import pytest

from firmware_iface.emulators.modbus_pdu import answer_request
from firmware_iface.emulators.rtu_bus import compute_bitwise_crc
from firmware_iface.links.modbus_rtu import (
    RtuBus,
    compute_crc16,
    extract_reply,
    parse_rtu_url,
    rtu_frame,
)
from firmware_iface.links.serial_port import SerialSettings
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError
from tests.support.virtual_time import run_virtual, stand_still
from tests.worlds.faulty_devices import MemoryWire, RtuBusEmulator, SerialFaults

LINE = SerialSettings(115_200)
TIMEOUT_S = 0.05


class Words:
    """A table of registers that remembers its requests."""

    def __init__(self) -> None:
        self.words = list(range(100, 120))
        self.asked: list[tuple[str, int]] = []

    def read(self, address: int, count: int) -> list[int]:
        self.asked.append(("read", address))
        return self.words[address : address + count]

    def write(self, address: int, words: Sequence[int]) -> None:
        self.asked.append(("write", address))
        self.words[address : address + len(words)] = words


class Bus:
    """Two slaves on a bus in memory."""

    def __init__(self, echo_test: bool = True) -> None:
        self.tables = {1: Words(), 2: Words()}
        slaves = {unit: partial(answer_request, table=table) for unit, table in self.tables.items()}
        self.emulator = RtuBusEmulator(LINE, slaves, echo_test=echo_test)
        self.wire = MemoryWire(self.emulator)
        self.bus = RtuBus(self.wire, quiet_s=TIMEOUT_S)
        self.first, self.second = (self.bus.device(unit, TIMEOUT_S) for unit in (1, 2))
        self.sent: list[bytes] = []
        receive_original = self.emulator.receive

        def listen(data: bytes) -> None:
            self.sent.append(data)
            receive_original(data)

        self.emulator.receive = listen  # type: ignore[method-assign]


def on_bus(test: Callable[[Bus], Coroutine[Any, Any, None]], echo_test: bool = True) -> None:
    """Run a test on a connected bus in virtual time."""

    async def connected() -> None:
        bus = Bus(echo_test)
        await bus.first.connect()
        await test(bus)
        await bus.first.close()
        assert asyncio.all_tasks() == {asyncio.current_task()}

    run_virtual(connected())


@pytest.mark.parametrize(
    ("body", "crc"),
    [
        (b"123456789", 0x4B37),  # the customary check value of CRC-16/MODBUS
        (bytes.fromhex("01 06 00 00 03 E8"), 0x7489),  # Waveshare's manual: 89 74 on the wire
        (bytes.fromhex("02 07"), 0x1241),  # Modbus over serial line 1.02, 6.2.2
        (b"", 0xFFFF),
    ],
)
def test_crc_vectors(body: bytes, crc: int) -> None:
    assert compute_crc16(body) == crc
    assert compute_bitwise_crc(body) == crc


def test_the_vendors_frame() -> None:
    assert rtu_frame(1, struct.pack(">BHH", 6, 0, 1000)) == bytes.fromhex("01 06 00 00 03 E8 89 74")


@pytest.mark.parametrize(
    ("url", "port", "settings"),
    [
        ("rtu:///dev/ttyUSB0", "/dev/ttyUSB0", SerialSettings(19_200, parity="E")),
        ("rtu:///dev/ttyS1?baud=115200&parity=N", "/dev/ttyS1", SerialSettings(115_200)),
        (
            "rtu://usb:0403:6001:A5?stop_bits=2&parity=N",
            "usb:0403:6001:A5",
            SerialSettings(19_200, 8, "N", 2),
        ),
    ],
)
def test_urls(url: str, port: str, settings: SerialSettings) -> None:
    assert parse_rtu_url(url) == (port, settings)


@pytest.mark.parametrize(
    "url",
    [
        "tcp://host",
        "rtu://",
        "rtu:///dev/x?bauds=1",
        "rtu:///dev/x?baud=fast",
        "rtu:///dev/x?baud=12345",
    ],
)
def test_urls_that_are_none(url: str) -> None:
    with pytest.raises(ValueError, match=r"rtu://|baud|tcp://"):
        parse_rtu_url(url)


@pytest.mark.parametrize("unit_id", [0, 248])
def test_unit_ids_that_rtu_does_not_have(unit_id: int) -> None:
    with pytest.raises(ValueError, match=f"unit_id = {unit_id}"):
        RtuBus(MemoryWire(RtuBusEmulator(LINE, {}))).device(unit_id, 0.1)


GOOD = rtu_frame(1, bytes([3, 4, 0, 1, 0, 2]))


@pytest.mark.parametrize(
    ("heard", "message"),
    [
        (rtu_frame(2, GOOD[1:-2]), "answer from unit 2, expected unit 1"),
        (rtu_frame(1, bytes([4]) + GOOD[2:-2]), "function code 4"),
        (rtu_frame(1, bytes([3, 2, 0, 1])), "1 registers instead of 2"),
        (rtu_frame(1, bytes([3, 6, 0, 1, 0, 2, 0, 3])), "3 registers instead of 2"),
        (GOOD[:-1] + b"\0", "wrong checksum"),
        (GOOD + b"\0", "10 bytes instead of 9"),
        (rtu_frame(1, bytes([0x83, 2]))[:-1] + b"\0", "wrong checksum"),
    ],
)
def test_what_is_no_answer(heard: bytes, message: str) -> None:
    with pytest.raises(LinkError, match=message):
        extract_reply(heard, 1, 3, 9, "reading")


def test_an_answer_is_taken_when_its_last_byte_is_there() -> None:
    assert [extract_reply(GOOD[:n], 1, 3, 9, "reading") for n in range(1, 9)] == [None] * 8
    assert extract_reply(GOOD, 1, 3, 9, "reading") == GOOD[1:-2]


@pytest.mark.parametrize("bits", [1, 2, 3])
def test_no_answer_with_up_to_three_turned_bits_passes(bits: int) -> None:
    places = range(8 * len(GOOD))
    for first in places:
        spoilt = bytearray(GOOD)
        for bit in [(first + 11 * k) % (8 * len(GOOD)) for k in range(bits)]:
            spoilt[bit // 8] ^= 1 << bit % 8
        try:
            taken = extract_reply(bytes(spoilt), 1, 3, 9, "reading")
        except LinkError:
            continue
        assert taken is None  # a corrupted length byte leaves it waiting for more


def test_reads_and_writes() -> None:
    async def test(bus: Bus) -> None:
        assert await bus.first.read_holding(2, 3) == [102, 103, 104]
        await bus.first.write_register(2, 7)
        await bus.second.write_registers(3, [8, 9])
        assert bus.tables[1].words[2:4] == [7, 103]
        assert bus.tables[2].words[2:6] == [102, 8, 9, 105]
        with pytest.raises(DeviceRefusedError, match=r"exception 1 \(illegal function\)"):
            await bus.first.read_input(0, 1)

    on_bus(test)


def test_a_fence_comes_first_and_after_every_loss() -> None:
    async def test(bus: Bus) -> None:
        await bus.first.read_holding(0, 1)
        await bus.first.read_holding(0, 1)
        assert [frame[1] for frame in bus.sent] == [8, 3, 3]
        bus.emulator.faults.silent = True
        with pytest.raises(LinkError, match=r"no answer within 0.05 s"):
            await bus.first.read_holding(0, 1)
        bus.emulator.faults.silent = False
        await bus.first.read_holding(0, 1)
        assert [frame[1] for frame in bus.sent] == [8, 3, 3, 3, 8, 3]
        assert bus.sent[0] != bus.sent[4]  # each has a number of its own

    on_bus(test)


@pytest.mark.parametrize("echo_test", [True, False])
@pytest.mark.parametrize("lateness", [1.2, 1.9, 2.5, 3.5, 6.0])
def test_a_late_answer_is_never_the_next_one(lateness: float, echo_test: bool) -> None:
    async def test(bus: Bus) -> None:
        await bus.first.read_holding(0, 1)
        bus.emulator.faults.delay_s = lateness * TIMEOUT_S
        with pytest.raises(LinkError):
            await bus.first.read_holding(5, 1)
        bus.emulator.faults.delay_s = 0.0
        for _ in range(5):
            try:
                assert await bus.first.read_holding(9, 1) == [109]
            except LinkDownError:
                await bus.first.connect()
            except LinkError:
                continue
        assert await bus.first.read_holding(9, 1) == [109]

    on_bus(test, echo_test)


def test_an_answer_that_came_while_the_process_stood_still_is_taken() -> None:
    async def test(bus: Bus) -> None:
        await bus.first.read_holding(0, 1)
        bus.emulator.faults.delay_s = 0.5 * TIMEOUT_S
        asked = asyncio.create_task(bus.first.read_holding(5, 1))
        await asyncio.sleep(0.3 * TIMEOUT_S)
        stand_still(1.0)
        assert await asked == [105]

    on_bus(test)


def test_a_cancelled_request_is_finished_before_the_next() -> None:
    async def test(bus: Bus) -> None:
        await bus.first.read_holding(0, 1)
        bus.emulator.faults.delay_s = 0.5 * TIMEOUT_S
        cancelled = asyncio.create_task(bus.first.read_holding(5, 1))
        await asyncio.sleep(0.3 * TIMEOUT_S)
        cancelled.cancel()
        with pytest.raises(asyncio.CancelledError):
            await cancelled
        assert await bus.first.read_holding(9, 1) == [109]
        assert bus.tables[1].asked == [("read", 0), ("read", 5), ("read", 9)]

    on_bus(test)


def test_a_request_cancelled_before_its_turn_is_never_sent() -> None:
    async def test(bus: Bus) -> None:
        first = asyncio.create_task(bus.first.read_holding(5, 1))
        waiting = asyncio.create_task(bus.first.write_register(5, 1))
        await asyncio.sleep(0)
        waiting.cancel()
        assert await first == [105]
        await bus.first.read_holding(6, 1)
        assert bus.tables[1].asked == [("read", 5), ("read", 6)]

    on_bus(test)


def test_devices_of_a_bus_take_turns() -> None:
    async def test(bus: Bus) -> None:
        order: list[int] = []

        async def ask(unit: int) -> None:
            await (bus.first, bus.second)[unit - 1].read_holding(0, 1)
            order.append(unit)

        await asyncio.gather(*(ask(1) for _ in range(4)), *(ask(2) for _ in range(2)))
        assert order == [1, 2, 1, 2, 1, 1]

    on_bus(test)


def test_a_device_that_is_gone_leaves_the_others_alone() -> None:
    async def test(bus: Bus) -> None:
        missing = bus.bus.device(9, TIMEOUT_S)
        for _ in range(20):
            with pytest.raises(LinkError, match="no answer"):
                await missing.read_holding(0, 1)
            assert await bus.second.read_holding(1, 1) == [101]

    on_bus(test)


@pytest.mark.parametrize(
    "faults",
    [
        SerialFaults(garbage_bytes=9),
        SerialFaults(garbage_bytes=300),
        SerialFaults(bit_errors=3),
        SerialFaults(cut_bytes=1),
        SerialFaults(cut_bytes=8),
        SerialFaults(deaf=True),
        SerialFaults(question_bit_errors=1),
    ],
)
def test_each_fault_is_an_error_and_passes(faults: SerialFaults) -> None:
    async def test(bus: Bus) -> None:
        await bus.first.read_holding(0, 2)
        bus.emulator.faults = faults
        for _ in range(2):
            with pytest.raises(LinkError):
                await bus.first.read_holding(0, 2)
        bus.emulator.faults = SerialFaults()
        assert await bus.first.read_holding(0, 2) == [100, 101]

    on_bus(test)


@pytest.mark.parametrize(
    ("fault", "message"),
    [("wrong_unit", "answer from unit 2"), ("wrong_function", "function code 4")],
)
def test_faults_of_the_protocol(fault: str, message: str) -> None:
    async def test(bus: Bus) -> None:
        await bus.first.read_holding(0, 1)
        setattr(bus.emulator, fault, True)
        with pytest.raises(LinkError, match=message):
            await bus.first.read_holding(0, 1)

    on_bus(test)


def test_exceptions_have_their_types() -> None:
    async def test(bus: Bus) -> None:
        await bus.first.read_holding(0, 1)
        bus.emulator.exception_code = 2
        with pytest.raises(DeviceRefusedError, match="illegal address"):
            await bus.first.write_registers(0, [1])
        bus.emulator.exception_code = 6
        with pytest.raises(LinkError, match="device busy"):
            await bus.first.read_holding(0, 1)

    on_bus(test)


def test_a_pulled_plug_ends_a_request_at_once() -> None:
    async def test(bus: Bus) -> None:
        await bus.first.read_holding(0, 1)
        bus.emulator.faults.silent = True
        asking = asyncio.create_task(bus.first.read_holding(0, 1))
        await asyncio.sleep(0.1 * TIMEOUT_S)
        bus.wire.unplug()
        before_s = asyncio.get_running_loop().time()
        with pytest.raises(LinkDownError):
            await asking
        assert asyncio.get_running_loop().time() == before_s
        with pytest.raises(LinkDownError, match="not connected"):
            await bus.first.read_holding(0, 1)

    on_bus(test)


def test_a_dead_bus_is_given_up() -> None:
    async def test(bus: Bus) -> None:
        bus.emulator.faults.deaf = True
        errors = []
        while bus.first.connected:
            with pytest.raises(LinkError) as raised:
                await bus.first.read_holding(0, 1)
            errors.append(raised.type)
        assert errors == [LinkError] * 4 + [LinkDownError]

    on_bus(test)


def test_someone_else_talking_is_not_waited_for() -> None:
    async def test(bus: Bus) -> None:
        async def babble() -> None:
            while True:
                bus.emulator.send_answer(b"\x55" * 20)
                await asyncio.sleep(0.01)

        babbling = asyncio.create_task(babble())
        with pytest.raises(LinkError, match="never goes quiet"):
            await bus.first.read_holding(0, 1)
        babbling.cancel()
        await asyncio.wait([babbling])

    on_bus(test)
