"""Bounds on what a connection may cost before its sender has shown a session.

Anybody who reaches the port can open connections and leave them, send a request byte by byte, or
send headers without end. Each of these is cheap for the sender and keeps memory or a file
descriptor of the page. So a stranger's connection has a deadline for each request, a bound on its
bytes, and one of a fixed number of places; when all places are taken, the stranger that was active
longest ago is disconnected. A connection that has carried a valid session needs no place.
"""

from __future__ import annotations

import asyncio
import resource
from collections import OrderedDict
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

Client = tuple[str, int]

# More than the kernel hands over at once (uvicorn's backlog of 2048), so that a viewer's new
# connection is not ended by others of the same moment, before its request is read. Each takes some
# 20 kB.
STRANGERS_MAX = 2500
REQUEST_S = 10.0  # from the first byte of a request, or from the connection, to its last byte
HEAD_BYTES_MAX = 32_768
_FILES_WANTED = 65_536
_HANDSHAKE_S = 5.0
_TOO_LARGE = (
    b"HTTP/1.1 431 Request Header Fields Too Large\r\nconnection: close\r\ncontent-length: "
    b"0\r\n\r\n"
)
_TIMED_OUT = b"HTTP/1.1 408 Request Timeout\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"


class ConnectionGuard:
    """The open connections of strangers, by their address and port."""

    def __init__(self, strangers_max: int = STRANGERS_MAX) -> None:
        self._strangers_max = strangers_max
        self._strangers: OrderedDict[Client, asyncio.Transport] = OrderedDict()

    def __len__(self) -> int:
        return len(self._strangers)

    def add(self, client: Client, transport: asyncio.Transport) -> None:
        """Give a new connection a place; disconnect the stranger that was active longest ago if
        there is none.

        Parameters
        ----------
        client : Client
            Address and port of the sender.
        transport : Transport
            Of the connection.
        """
        self._strangers[client] = transport
        if len(self._strangers) > self._strangers_max:
            _, oldest = self._strangers.popitem(last=False)
            oldest.abort()

    def note_activity(self, client: Client) -> None:
        """Move a stranger behind all others in the order of disconnection."""
        if client in self._strangers:
            self._strangers.move_to_end(client)

    def mark_known(self, client: Client | None) -> None:
        """Exempt a connection: a request with a valid session came over it."""
        if client is not None:
            self._strangers.pop(client, None)

    def remove(self, client: Client) -> None:
        """Forget a connection that has ended."""
        self._strangers.pop(client, None)


class GuardedHttp(HttpToolsProtocol):
    """An HTTP connection with a deadline for each request and a bound on its head."""

    def __init__(self, guard: ConnectionGuard, **given: Any) -> None:
        super().__init__(**given)
        self._guard = guard
        self._deadline: asyncio.TimerHandle | None = None
        self._head_bytes = 0
        self._in_head = True

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a place and start the deadline of the first request."""
        super().connection_made(transport)
        if self.client is not None:
            self._guard.add(self.client, transport)
        self._start_deadline()

    def connection_lost(self, exc: Exception | None) -> None:
        """Leave the place."""
        self._stop_deadline()
        if self.client is not None:
            self._guard.remove(self.client)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Pass the bytes to the parser unless the head of the request is too long."""
        if self.transport.is_closing():
            return
        if self._in_head:
            # a chunk may hold the end of a head and a body, so only the bytes before it certainly
            # belong to the head
            if self._head_bytes > HEAD_BYTES_MAX:
                self._refuse(_TOO_LARGE)
                return
            self._head_bytes += len(data)
        super().data_received(data)

    def on_message_begin(self) -> None:
        """Start the deadline of a request."""
        super().on_message_begin()
        self._in_head = True
        self._head_bytes = 0
        self._start_deadline()

    def on_headers_complete(self) -> None:
        """Stop counting the bytes of the head."""
        self._in_head = False
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """Stop the deadline: the request is complete."""
        self._in_head = True
        self._head_bytes = 0
        self._stop_deadline()
        if self.client is not None:
            self._guard.note_activity(self.client)
        super().on_message_complete()

    def handle_websocket_upgrade(self) -> None:
        """Stop the deadline: the web socket has its own pings."""
        self._stop_deadline()
        super().handle_websocket_upgrade()

    def _start_deadline(self) -> None:
        self._stop_deadline()
        self._deadline = self.loop.call_later(REQUEST_S, self._refuse, _TIMED_OUT)

    def _stop_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _refuse(self, answer: bytes) -> None:
        """Answer if no answer has begun, and end the connection."""
        if self.transport is None or self.transport.is_closing():
            return
        if self.cycle is None or self.cycle.response_complete:
            self.transport.write(answer)
        self.transport.close()


def raise_file_limit() -> int:
    """Let the process open as many files as its hard limit admits; returns the places for half of
    them.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _FILES_WANTED if hard == resource.RLIM_INFINITY else min(hard, _FILES_WANTED)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    return min(STRANGERS_MAX, wanted // 2)


class PageLoop(asyncio.SelectorEventLoop):
    """An event loop whose TLS handshakes end within seconds: the page's server has no setting for
    that.
    """

    async def create_server(self, *given: Any, **options: Any) -> Any:
        """Create a server; see `asyncio.loop.create_server`."""
        if options.get("ssl") is not None:
            options.setdefault("ssl_handshake_timeout", _HANDSHAKE_S)
        return await super().create_server(*given, **options)
