"""The listening socket in the control process, which admits few clients at a time and reopens after
a failure.

`asyncio.start_unix_server` would accept all connections at once; here each waits for the one
before, so that a flood costs the ticks at most twenty new clients a second.
"""

import asyncio
import socket
import struct
from collections.abc import Awaitable, Callable

from membrane_ctrl.model import durations, events, port_events

BACKLOG = 64  # connections that may wait; the kernel refuses more
_INSIDE_MOST = 32
_PAUSE_S = 0.05
_LEAVE_S = 2.0  # then the run ends without waiting for clients
_AGAIN_S = 1.0
_RESET = struct.pack(
    "ii", 1, 0
)  # SO_LINGER: a refused connection leaves nothing behind in the kernel

Welcome = Callable[[socket.socket], Awaitable[None]]


class Endpoint:
    """Accepts connections and welcomes each in a task of its own.

    Parameters
    ----------
    name : str
        For messages.
    listener : socket
        Bound, listening, non-blocking; the endpoint closes it.
    welcome : callable
        Serves one connection to its end.
    record_event : callable
        Records an event.
    refused : callable
        Called with the refused peer and the reason.
    """

    def __init__(
        self,
        name: str,
        listener: socket.socket,
        welcome: Welcome,
        record_event: Callable[[events.Event], None],
        refused: Callable[[str, str], None],
    ) -> None:
        self._name = name
        self._listener = listener
        self._welcome = welcome
        self._record_event = record_event
        self._refused = refused
        self._inside: set[asyncio.Task[None]] = set()
        self._task: asyncio.Task[None] | None = None

    def open(self) -> None:
        """Start accepting."""
        self._task = asyncio.create_task(self._keep(), name=f"port {self._name}")

    async def close(self) -> None:
        """End all connections."""
        tasks = [*self._inside, *([self._task] if self._task else [])]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks, timeout=_LEAVE_S)
        self._listener.close()

    async def _keep(self) -> None:
        """Accept forever; report failures and retry."""
        failures = 0
        while True:
            try:
                await self._accept()
            except Exception as error:
                failures += 1
                again_s = durations.pause_s(failures, _AGAIN_S)
                self._record_event(port_events.PortFailed(self._name, str(error), again_s))
                await asyncio.sleep(again_s)
                continue
            if failures:
                failures = 0
                self._record_event(port_events.PortOpen(self._name))
            await asyncio.sleep(_PAUSE_S)

    async def _accept(self) -> None:
        connection, _ = await asyncio.get_running_loop().sock_accept(self._listener)
        if len(self._inside) >= _INSIDE_MOST:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            connection.close()
            self._refused(self._name, "too many connections")
            return
        task = asyncio.create_task(self._look_after(connection), name=f"port {self._name} client")
        self._inside.add(task)
        task.add_done_callback(self._inside.discard)

    async def _look_after(self, connection: socket.socket) -> None:
        try:
            await self._welcome(connection)
        except Exception as error:  # one client's error must not affect the others
            self._record_event(
                port_events.PortFailed(self._name, f"{type(error).__name__}: {error}")
            )
        finally:
            connection.close()
