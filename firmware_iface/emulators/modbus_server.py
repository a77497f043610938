"""A small Modbus TCP server for emulators, which can also answer wrongly on purpose.

It does not use the client's library: two independent implementations check each other, and a
library's server cannot be silent, late or short. Source: Modbus application protocol 1.1b3 and
messaging guide 1.0b.
"""

import asyncio
import struct
from collections.abc import Callable
from dataclasses import dataclass

_HEADER = struct.Struct(">HHHB")  # transaction, protocol (0), length of what follows, unit
_LENGTH_MAX = 254  # unit + the longest PDU of 253 bytes
Handler = Callable[[int, bytes], "Answer"]
"""Unit and request PDU to answer."""


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a request."""

    pdu: bytes = b""  # empty: nothing is sent
    # sent this much later; later requests of the connection are answered meanwhile
    delay_s: float = 0.0
    hang_up: bool = False  # the connection is dropped instead
    transaction_offset: int = 0  # added to the transaction id; other than 0 it is a wrong answer


class ModbusTcpServer:
    """Serves any number of clients.

    Parameters
    ----------
    handler : callable
        Answers each request as soon as it is complete; it must not block.
    host : str
        Address to listen on.
    port : int
        TCP port; 0 takes any free one.
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
        # TCP has no borders between messages: the header gives the length, from the unit on.
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
