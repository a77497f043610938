"""An event loop whose clock jumps to the next timer instead of waiting for it.

For emulated devices on a `MemoryWire`: an hour of late answers and timeouts takes seconds, and is
the same every time. Nothing in it may wait for the outside world.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class VirtualLoop(asyncio.SelectorEventLoop):
    """Starts at 0 s."""

    _scheduled: list[asyncio.TimerHandle]  # of asyncio's own loops: a heap, the next one first

    def __init__(self) -> None:
        self._now_s = 0.0
        super().__init__(_Jump(self))

    def time(self) -> float:
        """Virtual seconds."""
        return self._now_s

    def jump(self, seconds: float) -> None:
        """Let time pass."""
        self._now_s += seconds

    def jump_to_next_timer(self) -> None:
        """Let time pass until the next timer is due.

        Exactly until then: a sum of intervals would round otherwise with each timer more.
        """
        self._now_s = max(self._now_s, self._scheduled[0].when())


class _Jump(selectors.SelectSelector):
    def __init__(self, loop: VirtualLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None:
            raise RuntimeError("everything waits and no timer is set: this would wait forever")
        if timeout > 0.0:
            self._loop.jump_to_next_timer()
        return []


def run_virtual(main: Coroutine[Any, Any, T]) -> T:
    """Run to the end in virtual time."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(main)


def stand_still(seconds: float) -> None:
    """Let time go on at once, as it does for a process whose machine was paused."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    loop.jump(seconds)
