"""Attacks on a service of the mirror over plain HTTP and WebSocket, and what a logged-in user
notices of them.

The attacks know only the address of the service and the names in `Routes`, so that they apply to
every service that takes its place. Each attack is a program of its own, which shares no interpreter
with the measurement: `python -m tests.support.service_attacks ATTACK URL CLIENTS`.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import os
import re
import signal
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from urllib.parse import urlsplit

import httpx

Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@dataclass(frozen=True, slots=True)
class Routes:
    """Paths of a service, relative to its address."""

    login: str = "login"
    # what a viewer fetches every second
    live: str = "chart?hold=&signals=error_um&span=1+min&utc=true"
    history: str = "chart?hold=&signals={signal}&span={span}&utc={utc}"
    stop: str = "api/safety/stop?hold="
    socket: str = "_nicegui_ws/socket.io/?EIO=4&transport=websocket"


ROUTES = Routes()
_BEGIN_S = 60.0  # of an attack on a busy machine


async def connect(url: str) -> Streams:
    """Open a connection to a service."""
    parts = urlsplit(url)
    return await asyncio.open_connection(parts.hostname, parts.port)


def request_bytes(
    url: str, path: str, method: str = "GET", body: bytes = b"", *headers: str
) -> bytes:
    """A request as it is sent, its head complete."""
    parts = urlsplit(url)
    lines = [f"{method} {parts.path}{path} HTTP/1.1", f"Host: {parts.netloc}", *headers]
    if body or method == "POST":
        lines.append(f"Content-Length: {len(body)}")
    return "\r\n".join([*lines, "", ""]).encode() + body


async def _read_answer(reader: asyncio.StreamReader) -> int:
    """Read one answer; returns its status."""
    head = await reader.readuntil(b"\r\n\r\n")
    length = re.search(rb"(?i)content-length: *([0-9]+)", head)
    await reader.readexactly(int(length[1]) if length else 0)
    return int(head.split()[1])


async def status_of(url: str, raw: bytes, wait_s: float = 20.0) -> int:
    """Send raw bytes on a connection of their own.

    Returns
    -------
    int
        The status of the answer, 0 if the connection was closed without one.
    """
    reader, writer = await connect(url)
    try:
        async with asyncio.timeout(wait_s):
            with contextlib.suppress(OSError):
                writer.write(raw)
                await writer.drain()
            try:
                line = await reader.readline()
            except OSError:
                return 0
            return int(line.split()[1]) if line else 0
    finally:
        writer.close()


async def _flood_logins(url: str, streams: Streams, number: int) -> None:
    """Post wrong passwords for a name that no other client uses."""
    await _repeat_login(url, streams, f"x{number}", "yyyyyyyy")


async def _flood_owner(url: str, streams: Streams, number: int) -> None:
    """Post wrong passwords for the owner's name."""
    await _repeat_login(url, streams, "anna", f"guess{number:04}")


async def _repeat_login(url: str, streams: Streams, name: str, password: str) -> None:
    """Post a login without a pause, on one connection as long as it lives."""
    reader, writer = streams
    form = f"name={name}&password={password}".encode()
    raw = request_bytes(
        url, ROUTES.login, "POST", form, "Content-Type: application/x-www-form-urlencoded"
    )
    while True:
        writer.write(raw)
        await writer.drain()
        await _read_answer(reader)


async def _open_sockets(url: str, streams: Streams, number: int) -> None:
    """Ask for a web socket without a session, again and again."""
    reader, writer = streams
    key = base64.b64encode(os.urandom(16)).decode()
    upgrade = (
        "Upgrade: websocket",
        "Connection: Upgrade",
        f"Sec-WebSocket-Key: {key}",
        "Sec-WebSocket-Version: 13",
    )
    writer.write(request_bytes(url, ROUTES.socket, "GET", b"", *upgrade))
    await reader.read()


async def _stay_silent(url: str, streams: Streams, number: int) -> None:
    """Send nothing."""
    await streams[0].read()


async def _drip_head(url: str, streams: Streams, number: int) -> None:
    """Send a head that never ends, a byte a second."""
    writer = streams[1]
    writer.write(request_bytes(url, "")[:-2] + b"X-Padding: ")
    await _send_forever(writer, b"x", pause_s=1.0)


async def _drip_body(url: str, streams: Streams, number: int) -> None:
    """Announce a form and send it a byte a second."""
    writer = streams[1]
    writer.write(request_bytes(url, ROUTES.login, "POST", b"n" * 3000)[:-3000])
    await _send_forever(writer, b"n", pause_s=1.0)


async def _send_large_heads(url: str, streams: Streams, number: int) -> None:
    """Send headers without end, as fast as they are received."""
    writer = streams[1]
    writer.write(request_bytes(url, "")[:-2])
    await _send_forever(writer, b"X-Padding: " + b"x" * 8000 + b"\r\n")


async def _send_large_bodies(url: str, streams: Streams, number: int) -> None:
    """Post a body of a gigabyte, as fast as it is received."""
    writer = streams[1]
    path = ROUTES.login if number % 2 else ""
    head = request_bytes(url, path, "POST").replace(
        b"Content-Length: 0", b"Content-Length: 1000000000"
    )
    writer.write(head)
    await _send_forever(writer, b"x" * 65_536)


async def _send_forever(writer: asyncio.StreamWriter, data: bytes, pause_s: float = 0.0) -> None:
    """Send the same bytes until the connection is closed, as fast as they are received but for the
    pause.
    """
    while True:
        writer.write(data)
        await writer.drain()
        await asyncio.sleep(pause_s)


ATTACKS: dict[str, Callable[[str, Streams, int], Awaitable[None]]] = {
    "logins": _flood_logins,
    "owner": _flood_owner,
    "sockets": _open_sockets,
    "silence": _stay_silent,
    "slow-heads": _drip_head,
    "slow-bodies": _drip_body,
    "large-heads": _send_large_heads,
    "large-bodies": _send_large_bodies,
}


async def attack_until_ended(name: str, url: str, clients: int) -> None:
    """Run an attack with a number of clients; a client that is disconnected begins again.

    Prints a line once every client has begun.
    """
    waiting = set(range(clients))

    def begin(number: int) -> None:
        if waiting:
            waiting.discard(number)
            if not waiting:
                print("all clients have begun", flush=True)

    async def repeat(number: int) -> None:
        while True:
            with contextlib.suppress(OSError, EOFError, asyncio.IncompleteReadError):
                try:
                    streams = await connect(url)
                finally:
                    begin(number)
                with contextlib.closing(streams[1]):
                    await ATTACKS[name](url, streams, number)
            await asyncio.sleep(0.01)

    await asyncio.gather(*(repeat(number) for number in range(clients)))


@asynccontextmanager
async def attack(name: str, url: str, clients: int) -> AsyncIterator[None]:
    """An attack in a process of its own, until left."""
    words = ["-m", "tests.support.service_attacks", name, url, str(clients)]
    process = await asyncio.create_subprocess_exec(
        sys.executable, *words, stdout=asyncio.subprocess.PIPE
    )
    try:
        assert process.stdout is not None
        async with asyncio.timeout(_BEGIN_S):
            assert await process.stdout.readline(), "the attack has ended"
        yield
        assert process.returncode is None, "the attack has ended"
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGKILL)
        await process.communicate()


class Viewer:
    """A client of the service, which may log in; `address` is its own network address."""

    def __init__(self, url: str, address: str | None = None) -> None:
        self.url = url
        transport = httpx.AsyncHTTPTransport(local_address=address)
        self.client = httpx.AsyncClient(base_url=url, timeout=60.0, transport=transport)

    async def log_in(self, name: str, password: str) -> int:
        """Log in; returns the status of the answer."""
        answer = await self.client.post(ROUTES.login, data={"name": name, "password": password})
        return answer.status_code

    async def latencies_s(
        self, path: str, count: int, pause_s: float = 0.2, method: str = "GET"
    ) -> list[float]:
        """Times until an answer, sorted; each must be a success."""
        found = []
        for _ in range(count):
            begin_s = time.monotonic()
            answer = await self.client.request(method, path)
            found.append(time.monotonic() - begin_s)
            assert answer.status_code == 200, (path, answer.status_code, answer.text)
            await asyncio.sleep(pause_s)
        return sorted(found)

    async def __aenter__(self) -> Viewer:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.client.aclose()


if __name__ == "__main__":
    asyncio.run(attack_until_ended(sys.argv[1], sys.argv[2], int(sys.argv[3])))
