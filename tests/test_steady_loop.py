"""The loop of the asynchronous tests: what counts as time."""

from __future__ import annotations

import asyncio
import selectors
import socket
import time

import pytest
from steady_loop import SteadyLoop

STANDSTILL_S = 0.4


async def answers(connection: socket.socket) -> None:
    """A device."""
    loop = asyncio.get_running_loop()
    await loop.sock_sendall(connection, await loop.sock_recv(connection, 1))


async def test_a_device_that_stood_still_with_its_client_is_not_late() -> None:
    loop = asyncio.get_running_loop()
    here, there = socket.socketpair()
    with here, there:
        here.setblocking(False)
        there.setblocking(False)
        device = asyncio.create_task(answers(there))
        await asyncio.sleep(0)
        await loop.sock_sendall(here, b"?")
        loop.call_soon(time.sleep, STANDSTILL_S)
        async with asyncio.timeout(STANDSTILL_S / 2):
            assert await loop.sock_recv(here, 1) == b"?"
        await device


async def test_a_silent_device_is_late_after_its_time() -> None:
    begin_s = time.monotonic()
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.05):
            await asyncio.Event().wait()
    assert time.monotonic() - begin_s >= 0.05


def test_a_wait_in_which_the_machine_stood_still_is_no_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wait = selectors.DefaultSelector.select

    def stopped(selector: selectors.BaseSelector, timeout: float | None = None) -> object:
        time.sleep(STANDSTILL_S)
        return wait(selector, 0)  # type: ignore[arg-type]

    loop = SteadyLoop()
    begin_s = loop.time()
    monkeypatch.setattr(selectors.DefaultSelector, "select", stopped)
    loop._selector.select(0.01)  # type: ignore[attr-defined]
    assert loop.time() - begin_s < STANDSTILL_S / 2
    monkeypatch.undo()
    loop.close()


async def test_only_the_thread_of_the_loop_may_add_a_callback() -> None:
    loop = asyncio.get_running_loop()
    with pytest.raises(RuntimeError, match="Non-thread-safe"):
        await asyncio.to_thread(loop.call_soon, print)
    with pytest.raises(RuntimeError, match="Non-thread-safe"):
        await asyncio.to_thread(loop.call_later, 0.0, print)
