"""Keeps the order of a safety command and the commands that were published before it, over two
connections.

A `hold` that was published before a `lower` may arrive after it, because it is another
connection's, behind the rest of a flood. So each safety command publishes a marker that the
connection of the other commands receives behind all that was published earlier. Until the marker is
back, commands that could undo the safety command are refused.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

_REPEAT_S = 0.5  # a broker may drop a marker in a flood

PublishMarker = Callable[[str], Awaitable[None]]


class OrderBarrier:
    """The markers of one pair of connections; `instance` distinguishes them
    from those of other processes.
    """

    def __init__(self, instance: str) -> None:
        self._instance = instance
        self._sent = 0
        self._returned = 0
        self._newest = ""
        self._raised = asyncio.Event()

    def raise_for(self, kind: str) -> None:
        """Note a safety command."""
        self._newest = kind
        self._sent += 1
        self._raised.set()

    def receive(self, payload: bytes) -> None:
        """Note a marker that has come back."""
        # Anyone may publish on this topic: a number above the last one sent counts as that one.
        instance, _, number = payload[:64].decode("ascii", "replace").partition(" ")
        if instance == self._instance and number.isascii() and number.isdecimal():
            self._returned = max(self._returned, min(int(number), self._sent))

    @property
    def newest(self) -> str:
        """The safety command behind which commands that are received now may have been published;
        usually empty.
        """
        if self._returned < self._sent:
            return self._newest
        return ""

    async def run(self, publish: PublishMarker) -> None:
        """Publish markers until cancelled."""
        # The newest marker lies behind all older ones: if it is back, so are they, and a lost one
        # needs no repetition of its own.
        while True:
            await self._raised.wait()
            self._raised.clear()
            while self._returned < self._sent:
                await publish(f"{self._instance} {self._sent}")
                await self._wait_for_next()

    async def _wait_for_next(self) -> None:
        """Wait for another safety command, or until the marker should be back."""
        try:
            async with asyncio.timeout(_REPEAT_S):
                await self._raised.wait()
        except TimeoutError:
            return
        self._raised.clear()
