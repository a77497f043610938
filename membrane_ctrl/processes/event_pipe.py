"""A pipe between this process and a child, and events sent over it without ever waiting."""

import os
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from membrane_ctrl.model import events
from membrane_ctrl.processes.child import SPAWN_CONTEXT


def make_pipe() -> Any:
    """Make a two-way pipe between this process and a child."""
    return SPAWN_CONTEXT.Pipe()


def make_event_sender(status: Connection | None) -> Callable[[events.Event], None]:
    """Return a function that sends an event over `status`, or drops it if the pipe is full; it
    never waits.
    """
    if status is None:
        return lambda event: None
    os.set_blocking(status.fileno(), False)

    def report(event: events.Event) -> None:
        try:
            status.send({key: _shorten_value(value) for key, value in event.to_dict().items()})
        except OSError:  # full, or closed at the other end
            return

    return report


def _shorten_value(value: Any) -> Any:
    """Shorten a message so that a pipe takes it whole or not at all."""
    if not isinstance(value, str):
        return value
    return value[:1000]
