"""The emulators' Modbus server: the protocol's rules, request by request."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Sequence

import pytest

from firmware_iface.emulators.modbus_pdu import RegisterRefusal, answer_request
from firmware_iface.emulators.modbus_server import Answer, ModbusTcpServer


class Table:
    """Ten registers; the last one is read-only."""

    def __init__(self) -> None:
        self.words = list(range(10))

    def read(self, address: int, count: int) -> list[int]:
        if address + count > len(self.words):
            raise RegisterRefusal(2)
        return self.words[address : address + count]

    def write(self, address: int, words: Sequence[int]) -> None:
        if address + len(words) > len(self.words) - 1:
            raise RegisterRefusal(2)
        self.words[address : address + len(words)] = words


@pytest.mark.parametrize(
    ("request_pdu", "answer"),
    [
        (struct.pack(">BHH", 3, 4, 2), bytes([3, 4, 0, 4, 0, 5])),
        (struct.pack(">BHH", 6, 4, 77), struct.pack(">BHH", 6, 4, 77)),
        (struct.pack(">BHHB2H", 16, 4, 2, 4, 7, 8), struct.pack(">BHH", 16, 4, 2)),
        (struct.pack(">BHHHHBH", 23, 0, 2, 1, 1, 2, 99), bytes([23, 4, 0, 0, 0, 99])),
        (struct.pack(">BHH", 3, 9, 2), bytes([0x83, 2])),
        (struct.pack(">BHH", 3, 0, 0), bytes([0x83, 3])),
        (struct.pack(">BHH", 3, 0, 126), bytes([0x83, 3])),
        (struct.pack(">BH", 3, 0), bytes([0x83, 3])),
        (struct.pack(">BHHB2H", 16, 4, 2, 2, 7, 8), bytes([0x90, 3])),
        (struct.pack(">BHHBH", 16, 4, 2, 4, 7), bytes([0x90, 3])),
        (struct.pack(">BHHB", 16, 4, 0, 0), bytes([0x90, 3])),
        (struct.pack(">BHH", 4, 0, 1), bytes([0x84, 1])),
        (bytes([7]), bytes([0x87, 1])),
    ],
)
def test_answers(request_pdu: bytes, answer: bytes) -> None:
    assert answer_request(request_pdu, Table()) == answer


def test_a_refused_read_write_writes_nothing() -> None:
    table = Table()
    assert answer_request(struct.pack(">BHHHHBH", 23, 9, 2, 1, 1, 2, 99), table) == bytes([0x97, 2])
    assert table.words[1] == 1


async def _talk(requests: list[bytes], replies_bytes: int) -> bytes:
    """Send the pieces one by one to a server that answers with the PDU it got."""
    server = ModbusTcpServer(lambda unit, pdu: Answer(bytes([unit]) + pdu), "127.0.0.1", 0)
    await server.start()
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    try:
        for piece in requests:
            writer.write(piece)
            await writer.drain()
            await asyncio.sleep(0)
        async with asyncio.timeout(5):
            return await reader.readexactly(replies_bytes) if replies_bytes else await reader.read()
    finally:
        writer.close()
        await server.stop()


async def test_a_request_in_pieces_and_two_at_once_are_answered() -> None:
    first = struct.pack(">HHHBBB", 1, 0, 3, 9, 3, 5)
    second = struct.pack(">HHHBB", 2, 0, 2, 9, 4)
    wanted = struct.pack(">HHHBBBB", 1, 0, 4, 9, 9, 3, 5) + struct.pack(">HHHBBB", 2, 0, 3, 9, 9, 4)
    whole = first + second
    assert await _talk([whole[:3], whole[3:8], whole[8:]], len(wanted)) == wanted


@pytest.mark.parametrize(
    "header", [struct.pack(">HHHBB", 1, 7, 2, 1, 3), struct.pack(">HHHBB", 1, 0, 300, 1, 3)]
)
async def test_what_is_not_modbus_is_hung_up_on(header: bytes) -> None:
    try:
        received = await _talk([header], 0)
    except ConnectionResetError:
        received = b""
    assert received == b""


async def test_a_busy_port_is_an_os_error() -> None:
    first = ModbusTcpServer(lambda unit, pdu: Answer(pdu), "127.0.0.1", 0)
    await first.start()
    second = ModbusTcpServer(lambda unit, pdu: Answer(pdu), "127.0.0.1", first.port)
    with pytest.raises(OSError, match="address already in use"):
        await second.start()
    await second.stop()
    await first.stop()


async def test_an_answer_still_due_dies_with_its_connection() -> None:
    asked = asyncio.Event()

    def late(unit: int, pdu: bytes) -> Answer:
        asked.set()
        return Answer(pdu, delay_s=3600)

    server = ModbusTcpServer(late, "127.0.0.1", 0)
    await server.start()
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    writer.write(struct.pack(">HHHBB", 1, 0, 2, 1, 3))
    await asked.wait()
    await server.stop()
    assert await asyncio.wait_for(reader.read(), 5) == b""
    writer.close()
    await writer.wait_closed()
