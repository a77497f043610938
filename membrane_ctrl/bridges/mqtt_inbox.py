"""Incoming MQTT messages are handled as they arrive; none waits, so a flood cannot fill a queue."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable

import aiomqtt

_REPORTS_MOST = 64  # answers that wait to be published

HandleMessage = Callable[[aiomqtt.Message], None]


class Inbox(asyncio.Queue[aiomqtt.Message]):
    """Takes the place of aiomqtt's queue and passes each message to `handle`; it stays empty."""

    def __init__(self, handle: HandleMessage) -> None:
        super().__init__()
        self._handle = handle

    def put_nowait(self, item: aiomqtt.Message) -> None:
        """Handle a message."""
        self._handle(item)


class Reports:
    """Answers to commands, published in order. Of a flood of refusals, those for which there is no
    room are counted.

    Parameters
    ----------
    publish : callable
        Publishes one answer.
    pause_s : float
        Between two answers.
    """

    def __init__(self, publish: Callable[[str], Awaitable[None]], pause_s: float) -> None:
        self._publish = publish
        self._pause_s = pause_s
        self._waiting: deque[str] = deque()
        self._uncounted = 0
        self._added = asyncio.Event()

    def add(self, answer: str) -> None:
        """Publish an answer soon; those of commands that were sent to the hold are few."""
        self._waiting.append(answer)
        self._added.set()

    def add_refusal(self, answer: str) -> None:
        """Publish the refusal of a command that was not sent, or count it."""
        if len(self._waiting) < _REPORTS_MOST:
            self.add(answer)
        else:
            self._uncounted += 1

    async def run(self) -> None:
        """Publish until cancelled."""
        while True:
            await self._added.wait()
            if self._waiting:
                await self._publish(self._waiting.popleft())
            elif self._uncounted:
                count, self._uncounted = self._uncounted, 0
                await self._publish(f"{count} more commands were refused: too many at once")
            else:
                self._added.clear()
            await asyncio.sleep(self._pause_s)
