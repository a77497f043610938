"""aiomqtt's client, whose calls keep a cancellation."""

from __future__ import annotations

import asyncio
from typing import Any

import aiomqtt


class CancellableClient(aiomqtt.Client):
    """Raises a cancellation that arrives in the moment in which the broker confirms a call.

    aiomqtt awaits confirmations with `asyncio.wait_for`, which loses such a cancellation in Python
    3.11 (https://github.com/python/cpython/issues/86296): the task would continue and nothing would
    end it.
    """

    async def publish(self, *args: Any, **kwargs: Any) -> None:
        """Publish a message, as `aiomqtt.Client.publish`."""
        await super().publish(*args, **kwargs)
        raise_lost_cancellation()

    async def subscribe(self, *args: Any, **kwargs: Any) -> Any:
        """Subscribe to topics, as `aiomqtt.Client.subscribe`."""
        granted = await super().subscribe(*args, **kwargs)
        raise_lost_cancellation()
        return granted


def raise_lost_cancellation() -> None:
    """Raise CancelledError if the running task has been asked to end."""
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError
