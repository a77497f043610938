"""The event loop of the tests: its time stops whenever the machine does.

A virtual machine that is paused for a second, or a processor that others take, stops a test's
device and its client alike, while the clock goes on. On this loop such a pause causes no time-out;
a device that is silent while the loop runs still is.
"""

from __future__ import annotations

import asyncio
import selectors
import time

LATE_S = 0.1  # later than that, the loop was suspended


class SteadyLoop(asyncio.SelectorEventLoop):
    """Real time, less that in which the loop overslept or a callback took long."""

    def __init__(self) -> None:
        self._stood_s = 0.0
        super().__init__(_Watched(self))

    def time(self) -> float:
        """Seconds in which the loop ran or waited for something."""
        return super().time() - self._stood_s

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
