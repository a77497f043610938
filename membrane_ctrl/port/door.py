"""A listening socket in the control process: lets in few at a time, and opens again by itself after a failure.

`asyncio.start_server` would accept, and shake hands with, whoever comes in one go; here every newcomer waits for the
one before. A flood of connections so costs the tick no more than twenty of them a second.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable

from membrane_ctrl.tick import Event

BACKLOG = 8  # who waits at the door while another comes in; the kernel turns away the rest
_INSIDE_MOST = 32
_PAUSE_S = 0.05
_LEAVE_S = 2.0  # then the run ends without them
_AGAIN_S, _AGAIN_MOST_S = 1.0, 60.0

Welcome = Callable[[socket.socket], Awaitable[None]]


class Door:
    """Accepts connections and welcomes each in a task of its own.

    Parameters
    ----------
    name : str
        For messages.
    listener : socket
        Bound, listening, not blocking; the door closes it.
    welcome : callable
        Looks after one connection to its end, and closes it.
    tell : callable
        Puts an event on record.
    """

    def __init__(self, name: str, listener: socket.socket, welcome: Welcome, tell: Callable[[Event], None]) -> None:
        self._name = name
        self._listener = listener
        self._welcome = welcome
        self._tell = tell
        self._inside: set[asyncio.Task[None]] = set()
        self._task: asyncio.Task[None] | None = None

    def open(self) -> None:
        """Begin to accept."""
        self._task = asyncio.create_task(self._keep(), name=f"port {self._name}")

    async def close(self) -> None:
        """End everything behind the door."""
        tasks = [*self._inside, *([self._task] if self._task else [])]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks, timeout=_LEAVE_S)
        self._listener.close()

    async def _keep(self) -> None:
        """Accept for ever; what fails is said, and tried again."""
        again_s = 0.0
        while True:
            try:
                await self._accept()
            except Exception as error:
                again_s = min(max(2.0 * again_s, _AGAIN_S), _AGAIN_MOST_S)
                self._tell({"kind": "port_failed", "port": self._name, "message": str(error), "again_s": again_s})
                await asyncio.sleep(again_s)
                continue
            if again_s:
                again_s = 0.0
                self._tell({"kind": "port_open", "port": self._name})
            await asyncio.sleep(_PAUSE_S)

    async def _accept(self) -> None:
        connection, _ = await asyncio.get_running_loop().sock_accept(self._listener)
        if len(self._inside) >= _INSIDE_MOST:
            connection.close()
            return
        task = asyncio.create_task(self._look_after(connection), name=f"port {self._name} client")
        self._inside.add(task)
        task.add_done_callback(self._inside.discard)

    async def _look_after(self, connection: socket.socket) -> None:
        try:
            await self._welcome(connection)
        except Exception as error:  # one client's trouble is nobody else's
            self._tell({"kind": "port_failed", "port": self._name, "message": f"{type(error).__name__}: {error}"})
        finally:
            connection.close()
