"""A connection that carries one message per line, with limits of time and memory.

A peer that sends half a line, or does not read, costs the hold nothing: it is disconnected.
"""

from __future__ import annotations

import asyncio
import socket
from typing import Any

from membrane_ctrl.control_port.protocol import MESSAGE_BYTES, RequestError, encode

_LINE_S = 5.0  # to complete a line
_CHUNK_BYTES = 4096  # read at once: at most a few hundred short lines, 0.3 ms
# A reader this far behind is dropped: a 10 Hz watcher after a minute
_UNREAD_BYTES = 1 << 20


class SlowReaderError(ConnectionError):
    """The peer has not read for too long."""


class LineConnection:
    """Reads and writes lines."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self._part = b""  # of a line that is not complete yet

    @classmethod
    async def on(cls, connection: socket.socket) -> LineConnection:
        """Take over an accepted connection. Raises OSError."""
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader(limit=MESSAGE_BYTES, loop=loop)
        protocol = asyncio.StreamReaderProtocol(reader, loop=loop)
        transport, _ = await loop.connect_accepted_socket(lambda: protocol, connection)
        return cls(reader, asyncio.StreamWriter(transport, protocol, reader, loop))

    async def lines(self) -> list[bytes] | None:
        """The complete lines that have arrived, at least one; None when the peer has gone.

        Raises RequestError if a line is too long or too slow.
        """
        begun_s: float | None = None
        while True:
            # A peer may be silent for hours between lines, but not within one.
            now_s = asyncio.get_running_loop().time()
            if self._part and begun_s is None:
                begun_s = now_s
            left_s = None if begun_s is None else begun_s + _LINE_S - now_s
            try:
                # not `wait_for`, which loses a cancellation that coincides with its result
                async with asyncio.timeout(left_s):
                    chunk = await self._reader.read(_CHUNK_BYTES)
            except TimeoutError:
                raise RequestError(f"a message must be complete within {_LINE_S:g} s") from None
            except OSError:
                return None
            if not chunk:
                return None
            *complete, self._part = (self._part + chunk).split(b"\n")
            longest = max(map(len, (*complete, self._part)))
            if longest >= MESSAGE_BYTES:
                raise RequestError(f"a message may have at most {MESSAGE_BYTES} bytes")
            if complete:
                return complete

    @property
    def unread_bytes(self) -> int:
        """What was sent and not yet taken by the peer's system."""
        return self._writer.transport.get_write_buffer_size()

    def send(self, message: dict[str, Any]) -> None:
        """Send without waiting. Raises SlowReaderError (and ends the connection) if too much is
        unread.
        """
        transport = self._writer.transport
        if transport.is_closing():
            return
        if transport.get_write_buffer_size() > _UNREAD_BYTES:
            transport.abort()
            raise SlowReaderError("does not read its messages")
        self._writer.write(encode(message))

    async def close(self) -> None:
        """Send remaining data if possible without waiting, and end."""
        self._writer.close()
        try:
            async with asyncio.timeout(1.0):
                await self._writer.wait_closed()
        except (TimeoutError, OSError):
            self._writer.transport.abort()

    def abort(self) -> None:
        """End the connection now."""
        self._writer.transport.abort()
