"""One connection as lines: bounded, and never waited for."""

from __future__ import annotations

import asyncio
import socket
import ssl
from typing import Any

from membrane_ctrl.port.protocol import MESSAGE_BYTES, RequestError, encode

# Who has begun a line ends it in this time
_LINE_S = 5.0
# Who does not read gets this much behind, and is then dropped: a watcher of 10 Hz for a minute
_UNREAD_BYTES = 1 << 20
_HANDSHAKE_S = 3.0


class SlowReaderError(ConnectionError):
    """The peer has not read for too long."""


class Wire:
    """Lines in, lines out.

    Parameters
    ----------
    reader, writer
        Of the connection.
    """

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    @classmethod
    async def on(cls, connection: socket.socket, context: ssl.SSLContext | None = None) -> Wire:
        """Take over an accepted connection. Raises OSError (ssl.SSLError among them) if the handshake fails."""
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader(limit=MESSAGE_BYTES, loop=loop)
        protocol = asyncio.StreamReaderProtocol(reader, loop=loop)
        secured = {"ssl": context, "ssl_handshake_timeout": _HANDSHAKE_S} if context else {}
        transport, _ = await loop.connect_accepted_socket(lambda: protocol, connection, **secured)  # type: ignore[arg-type]
        return cls(reader, asyncio.StreamWriter(transport, protocol, reader, loop))

    @property
    def certificate(self) -> dict[str, Any]:
        """What the peer's certificate says, as `ssl.SSLSocket.getpeercert`."""
        found: dict[str, Any] | None = self._writer.get_extra_info("peercert")
        return found or {}

    async def line(self) -> bytes | None:
        """The next line; None when the peer has gone.

        Raises
        ------
        RequestError
            The line is too long or too slow; there is no way to find the next one.
        """
        try:
            first = await self._reader.read(1)  # a peer may think for hours between two lines
            if first in (b"", b"\n"):
                return first or None
            # not `wait_for`, which forgets a cancellation that comes together with its result
            async with asyncio.timeout(_LINE_S):
                rest = await self._reader.readuntil(b"\n")
        except asyncio.LimitOverrunError:
            raise RequestError(f"a message may have {MESSAGE_BYTES} bytes") from None
        except TimeoutError:
            raise RequestError(f"a message must be complete within {_LINE_S:g} s") from None
        except (asyncio.IncompleteReadError, OSError):
            return None
        return first + rest

    def send(self, message: dict[str, Any]) -> None:
        """Send without waiting. Raises SlowReaderError (and ends the connection) when too much is unread."""
        transport = self._writer.transport
        if transport.is_closing():
            return
        if transport.get_write_buffer_size() > _UNREAD_BYTES:
            transport.abort()
            raise SlowReaderError("does not read")
        self._writer.write(encode(message))

    async def until(self, end: bytes) -> bytes:
        """What comes up to `end`. Raises asyncio's LimitOverrunError or IncompleteReadError."""
        return await self._reader.readuntil(end)

    def send_bytes(self, data: bytes) -> None:
        """Send an answer that is no line."""
        self._writer.write(data)

    async def close(self) -> None:
        """Send what is left, if that goes at once, and end."""
        self._writer.close()
        try:
            async with asyncio.timeout(1.0):
                await self._writer.wait_closed()
        except (TimeoutError, OSError):
            self._writer.transport.abort()

    def abort(self) -> None:
        """End now."""
        self._writer.transport.abort()
