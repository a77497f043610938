"""What a child process says to the control process over its pipe, without ever waiting for it."""

from __future__ import annotations

import os
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from membrane_ctrl.tick import Event

ALIVE = "alive"


def alive(for_s: float) -> Event:
    """It is at work, and will say so again within `for_s` seconds (`post.Post` sees that it does)."""
    return {"kind": ALIVE, "for_s": for_s}


def reporter(status: Connection | None) -> Callable[[dict[str, Any]], None]:
    """A function that sends a dict over `status` if there is room for it now, and otherwise lets it go."""
    if status is None:
        return lambda message: None
    os.set_blocking(status.fileno(), False)

    def report(message: dict[str, Any]) -> None:
        try:
            status.send({key: _short(value) for key, value in message.items()})
        except OSError:  # full, or nobody at the other end: recording goes on
            return

    return report


def _short(value: Any) -> Any:
    """A message this short goes into a pipe whole or not at all, so that the other end never sees half of one."""
    return value[:1000] if isinstance(value, str) else value
