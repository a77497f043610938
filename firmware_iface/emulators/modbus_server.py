"""A small Modbus TCP server for emulators, which can also answer wrongly on purpose.

It does not use the client's library: two independent implementations check each other, and a
library's server cannot be silent, late or short. Source: Modbus application protocol 1.1b3 and
messaging guide 1.0b.
"""

import asyncio
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from firmware_iface.emulators.serial_device import SerialDevice
from firmware_iface.links.serial_port import SerialSettings

READ_HOLDING, WRITE_SINGLE, WRITE_MULTIPLE, READ_WRITE = 3, 6, 16, 23
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE, BUSY = 1, 2, 3, 4, 6

_HEADER = struct.Struct(">HHHB")  # transaction, protocol (0), length of what follows, unit
_LENGTH_MAX = 254  # unit + the longest PDU of 253 bytes
_READ_MAX, _WRITE_MAX, _READ_WRITE_MAX = 125, 123, 121  # words in one transaction


class RegisterRefusal(Exception):  # noqa: N818 - an answer of the protocol, not an error of the program
    """A request the device answers with an exception code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"Modbus exception {code}")
        self.code = code


class RegisterTable(Protocol):
    """The registers that function codes read and write."""

    def read(self, address: int, count: int) -> list[int]:
        """Words. Raises RegisterRefusal."""

    def write(self, address: int, words: Sequence[int]) -> None:
        """All of it or nothing. Raises RegisterRefusal."""


def respond(pdu: bytes, table: RegisterTable) -> bytes:
    """The answer to a request: function code and data, or an exception."""
    try:
        return pdu[:1] + _respond(pdu[0], pdu[1:], table)
    except RegisterRefusal as refusal:
        return exception_pdu(pdu, refusal.code)
    except struct.error:  # the request is shorter than its function code needs
        return exception_pdu(pdu, ILLEGAL_VALUE)


def exception_pdu(pdu: bytes, code: int) -> bytes:
    """The exception answer to a request."""
    return bytes([pdu[0] | 0x80, code])


def _respond(function_code: int, data: bytes, table: RegisterTable) -> bytes:
    if function_code == READ_HOLDING:
        address, count = struct.unpack(">HH", data)
        return _words_read(table, address, count)
    if function_code == WRITE_SINGLE:
        address, word = struct.unpack(">HH", data)
        table.write(address, [word])
        return data
    if function_code == WRITE_MULTIPLE:
        address, words = _words_written(data, _WRITE_MAX)
        table.write(address, words)
        return data[:4]
    if function_code == READ_WRITE:
        read_address, read_count = struct.unpack_from(">HH", data)
        address, words = _words_written(data[4:], _READ_WRITE_MAX)
        _words_read(
            table, read_address, read_count
        )  # refused as a whole: a wrong read writes nothing
        table.write(address, words)
        return _words_read(table, read_address, read_count)
    raise RegisterRefusal(ILLEGAL_FUNCTION)


def _words_read(table: RegisterTable, address: int, count: int) -> bytes:
    if not 1 <= count <= _READ_MAX:
        raise RegisterRefusal(ILLEGAL_VALUE)
    return struct.pack(f">B{count}H", 2 * count, *table.read(address, count))


def _words_written(data: bytes, most: int) -> tuple[int, list[int]]:
    address, count, size = struct.unpack_from(">HHB", data)
    if not 1 <= count <= most or size != 2 * count or len(data) != 5 + size:
        raise RegisterRefusal(ILLEGAL_VALUE)
    return address, list(struct.unpack_from(f">{count}H", data, 5))


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a request."""

    pdu: bytes = b""  # empty: nothing is sent
    # sent this much later; later requests of the connection are answered meanwhile
    delay_s: float = 0.0
    hang_up: bool = False  # the connection is dropped instead
    transaction_offset: int = 0  # added to the transaction id; other than 0 it is a wrong answer


Handler = Callable[[int, bytes], Answer]
"""Unit and request PDU to answer."""


class ModbusTcpServer:
    """Serves any number of clients, each request answered by
    `handler` as soon as it is complete.
    """

    def __init__(self, handler: Handler, host: str, port: int) -> None:
        self._handler = handler
        self._host = host
        self._port = port
        self._server: asyncio.Server | None = None
        self._connections: set[_Connection] = set()

    @property
    def port(self) -> int:
        """The port in use (the one given, or the one the system chose for 0)."""
        return self._port

    async def start(self) -> None:
        """Listen. Raises OSError, for example when the port is busy."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._connection, self._host, self._port)
        self._port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        """Close the port and all connections."""
        if self._server is not None:
            self._server.close()
            self.drop_connections()
            await self._server.wait_closed()
            self._server = None
            await asyncio.sleep(0)  # the loop closes aborted sockets in its next round

    def drop_connections(self) -> None:
        """Hang up on all clients."""
        for connection in tuple(self._connections):
            connection.hang_up()

    def _connection(self) -> "_Connection":
        return _Connection(self._handler, self._connections)


class _Connection(asyncio.Protocol):
    """One client."""

    def __init__(self, handler: Handler, connections: set["_Connection"]) -> None:
        self._handler = handler
        self._connections = connections
        self._buffer = b""
        self._late: set[asyncio.TimerHandle] = set()
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)  # a TCP server has no other
        self._transport = transport
        self._connections.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        self._connections.discard(self)
        for timer in self._late:
            timer.cancel()

    def hang_up(self) -> None:
        """Drop the connection at once."""
        if self._transport is not None:
            self._transport.abort()

    def data_received(self, data: bytes) -> None:
        self._buffer += data
        while len(self._buffer) > _HEADER.size:
            transaction, protocol, length, unit = _HEADER.unpack_from(self._buffer)
            if protocol != 0 or not 2 <= length <= _LENGTH_MAX:
                return self.hang_up()  # not Modbus: there is no way to find the next request in it
            end = _HEADER.size - 1 + length
            if len(self._buffer) < end:
                return None
            pdu, self._buffer = self._buffer[_HEADER.size : end], self._buffer[end:]
            self._answer(transaction, unit, self._handler(unit, pdu))
        return None

    def _answer(self, transaction: int, unit: int, answer: Answer) -> None:
        if answer.hang_up:
            return self.hang_up()
        if not answer.pdu:
            return None
        transaction = (transaction + answer.transaction_offset) % 2**16
        frame = _HEADER.pack(transaction, 0, len(answer.pdu) + 1, unit) + answer.pdu
        if answer.delay_s > 0:
            self._late.add(asyncio.get_running_loop().call_later(answer.delay_s, self._send, frame))
        else:
            self._send(frame)
        return None

    def _send(self, frame: bytes) -> None:
        if self._transport is not None:
            self._transport.write(frame)


# Any Modbus device as an RTU slave on an emulated serial line, alone or with others on the same
# bus.

_SHORTEST = 4  # unit, function, CRC
_LONGEST = 256  # of a frame; bytes without a silence between them never end otherwise
# far above the 1.75 ms of the standard: a program's bytes may be held up between two reads
_SILENCE_S = 0.005
DIAGNOSTICS = 8

PduHandler = Callable[[bytes], bytes]
"""Request PDU to answer PDU; empty for no answer."""


class RtuBusEmulator(SerialDevice):
    """All slaves of one bus, by unit id with what answers them (`lambda pdu: respond(pdu, table)`).

    Without `echo_test` function 8 ("return query data") is refused.
    """

    def __init__(
        self, settings: SerialSettings, slaves: Mapping[int, PduHandler], echo_test: bool = True
    ) -> None:
        super().__init__(settings)
        self._slaves = slaves
        self._echo_test = echo_test
        self._heard = b""
        self._heard_s = 0.0

    def received(self, data: bytes) -> None:
        """Answer a frame as soon as its CRC is right; after a silence the next one begins."""
        now_s = asyncio.get_running_loop().time()
        self._heard = data if now_s - self._heard_s > _SILENCE_S else self._heard + data
        self._heard_s = now_s
        frame = self._heard = self._heard[-_LONGEST:]
        if len(frame) < _SHORTEST or struct.unpack("<H", frame[-2:])[0] != bitwise_crc(frame[:-2]):
            return
        self._heard = b""
        unit, pdu = frame[0], frame[1:-2]
        if unit in self._slaves and (body := self.answer(unit, pdu)):
            self.say(body + struct.pack("<H", bitwise_crc(body)))

    def answer(self, unit: int, pdu: bytes) -> bytes:
        """Unit id and answer PDU to a request; empty for none."""
        echoed = self._echo_test and pdu[0] == DIAGNOSTICS and pdu[1:3] == b"\0\0"
        reply = pdu if echoed else self._slaves[unit](pdu)
        return bytes([unit]) + reply if reply else b""


def bitwise_crc(data: bytes) -> int:
    """The CRC of Modbus, bit by bit as in the standard's figure:
    independent of the link's table.
    """
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            carry = crc & 1
            crc >>= 1
            if carry:
                crc ^= 0xA001
    return crc
