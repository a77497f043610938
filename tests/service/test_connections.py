"""A connection that shows no session is bounded in time, bytes and number."""

from __future__ import annotations

import asyncio
import contextlib
import time
from pathlib import Path

import pytest

from membrane_ctrl.service import connections
from membrane_ctrl.service.connections import ConnectionGuard
from tests.support.service_attacks import ROUTES, Viewer, connect, request_bytes
from tests.web.test_page_under_attack import PASSWORD, serving

ENDS_S = connections.REQUEST_S + 5.0


class Transport(asyncio.Transport):
    """A connection that notes whether it was ended."""

    aborted = False

    def abort(self) -> None:
        self.aborted = True


def test_the_stranger_who_was_silent_longest_gives_way() -> None:
    guard = ConnectionGuard(strangers_max=3)
    transports = {number: Transport() for number in range(5)}
    for number in range(3):
        guard.add(("a", number), transports[number])
    guard.note_activity(("a", 0))
    guard.mark_known(("a", 2))
    guard.add(("a", 3), transports[3])
    assert not any(each.aborted for each in transports.values()), "who is known needs no place"
    guard.add(("a", 4), transports[4])
    assert [number for number, each in transports.items() if each.aborted] == [1]
    for number in (0, 3, 4):
        guard.remove(("a", number))
    assert len(guard) == 0


async def ended(
    streams: list[tuple[asyncio.StreamReader, asyncio.StreamWriter]], within_s: float
) -> int:
    """Number of connections that the service ends within a time."""

    async def wait(reader: asyncio.StreamReader) -> bool:
        try:
            async with asyncio.timeout(within_s):
                while await reader.read(65_536):
                    pass
        except TimeoutError:
            return False
        except OSError:
            return True
        return True

    return sum(await asyncio.gather(*(wait(reader) for reader, _ in streams)))


@pytest.mark.real_time
async def test_strangers_have_a_deadline_a_bound_and_a_number(tmp_path: Path) -> None:
    places = connections.raise_file_limit()
    async with serving(tmp_path) as (_, url), Viewer(url) as anna:
        assert await anna.log_in("anna", PASSWORD) == 303
        await anna.latencies_s(ROUTES.live, 1)

        # of many silent connections, those that came first make room at once, long before the
        # deadline of the last
        silent = [await connect(url) for _ in range(places + 100)]
        assert await ended(silent[:90], 2.0) == 90
        assert await ended(silent[-90:], 1.0) == 0

        # a request that is not complete has a deadline
        slow = [await connect(url) for _ in range(3)]
        slow[0][1].write(request_bytes(url, "")[:-2])
        slow[1][1].write(request_bytes(url, ROUTES.login, "POST", b"n" * 100)[:-1])
        begin_s = time.monotonic()
        assert await ended([*silent, *slow], ENDS_S) == len(silent) + 3
        assert time.monotonic() - begin_s > 1.0
        for _, writer in (*silent, *slow):
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

        # headers and bodies without end are cut off early
        for head in (
            request_bytes(url, "")[:-2],
            request_bytes(url, ROUTES.login, "POST").replace(b"Length: 0", b"Length: 1000000000"),
            request_bytes(url, "", "POST").replace(b"Length: 0", b"Length: 1000000000"),
        ):
            _, writer = await connect(url)
            sent = 0
            writer.write(head)
            try:
                while sent < 50_000_000:
                    writer.write(b"X-Padding: " + b"x" * 65_536 + b"\r\n")
                    await writer.drain()
                    sent += 65_549
            except OSError:
                pass
            writer.transport.abort()
            assert sent < 20_000_000
        assert max(await anna.latencies_s(ROUTES.live, 3)) < 1.0
