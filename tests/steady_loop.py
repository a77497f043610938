"""The event loop of the tests: its time stops whenever the machine does.

A virtual machine that is paused for a second, or a processor that others take, stops a test's
device and its client alike, while the clock continues. On this loop such a pause causes no
time-out; a device that is silent while the loop runs still is.
"""

from __future__ import annotations

import asyncio
import selectors
import time
from collections.abc import Callable
from contextvars import Context
from typing import Any

LATE_S = 0.1  # later than that, the loop was suspended


class SteadyLoop(asyncio.SelectorEventLoop):
    """Real time, less that in which the loop overslept or a callback took long.

    A callback from another thread is an error, as in asyncio's debug mode. The rest of that mode
    stores the stack of each callback, which takes a fifth of the time of such tests.
    """

    def __init__(self) -> None:
        self._stood_s = 0.0
        super().__init__(_Watched(self))

    def time(self) -> float:
        """Seconds in which the loop ran or waited for something."""
        return super().time() - self._stood_s

    def call_soon(
        self, callback: Callable[..., Any], *args: Any, context: Context | None = None
    ) -> asyncio.Handle:
        """Raises a `RuntimeError` in any thread but the loop's own."""
        self._check_thread()  # type: ignore[attr-defined]
        return super().call_soon(callback, *args, context=context)

    def call_at(
        self, when: float, callback: Callable[..., Any], *args: Any, context: Context | None = None
    ) -> asyncio.TimerHandle:
        """Raises a `RuntimeError` in any thread but the loop's own."""
        self._check_thread()  # type: ignore[attr-defined]
        return super().call_at(when, callback, *args, context=context)

    def stood(self, seconds: float) -> None:
        """Exclude this time."""
        self._stood_s += seconds


class _Watched(selectors.DefaultSelector):  # type: ignore[misc, valid-type]
    def __init__(self, loop: SteadyLoop) -> None:
        super().__init__()
        self._loop = loop
        self._returned_s = time.monotonic()

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        begin_s = time.monotonic()
        if (ran_s := begin_s - self._returned_s) > LATE_S:
            self._loop.stood(ran_s)
            timeout = timeout and timeout + ran_s
        found: list[tuple[selectors.SelectorKey, int]] = super().select(timeout)
        self._returned_s = time.monotonic()
        if timeout is not None and (waited_s := self._returned_s - begin_s) > timeout + LATE_S:
            self._loop.stood(waited_s)
        return found
