"""A listening socket in the control process that admits few clients at a time and reopens after a
failure.

`asyncio.start_server` would accept all connections at once; here each waits for the one before, so
that a flood costs the ticks at most twenty handshakes a second.

A peer that has not identified itself (no handshake, no request) is a stranger. The number of
strangers is limited, in total and per address: the longest waiting one makes room for a newcomer,
so that nobody can block the queue. An address that connects too often is refused at once.
"""

import asyncio
import socket
import struct
from collections import Counter, OrderedDict
from collections.abc import Awaitable, Callable

from membrane_ctrl.model import durations, events, port_events

BACKLOG = 64  # connections that may wait; the kernel refuses more
_INSIDE_MOST = 32
_STRANGERS_MOST, _STRANGERS_EACH = 16, 4
_PAUSE_S = 0.05
# Per address: a person's terminal and a script or two; a flood gets a tenth of the handshakes
_BURST, _PER_S = 10.0, 2.0
_TURN_AWAY_S = 0.005  # each costs 50 us: a hundredth of a processor
_ADDRESSES_MOST = 1024  # addresses remembered
_LEAVE_S = 2.0  # then the run ends without waiting for clients
_AGAIN_S = 1.0
_RESET = struct.pack(
    "ii", 1, 0
)  # SO_LINGER: a refused connection leaves nothing behind in the kernel

LetIn = Callable[[], object]
Welcome = Callable[[socket.socket, LetIn], Awaitable[None]]


class Turns:
    """How often an address may connect: a token bucket each; forgets the address absent longest."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, address: str) -> bool:
        """Whether the address may connect now; counts the connection if so."""
        now_s = self._now()
        left, since_s = self._left.pop(address, (_BURST, now_s))
        left = min(_BURST, left + _PER_S * (now_s - since_s))
        may = left >= 1.0
        self._left[address] = (left - may, now_s)
        if len(self._left) > _ADDRESSES_MOST:
            self._left.popitem(last=False)
        return may


class Endpoint:
    """Accepts connections and welcomes each in a task of its own.

    Parameters
    ----------
    name : str
        For messages.
    listener : socket
        Bound, listening, non-blocking; the endpoint closes it.
    welcome : callable
        Serves one connection to its end; calls its second argument once the peer is identified.
    tell : callable
        Records an event.
    refused : callable
        Called with the refused peer and the reason.
    """

    def __init__(
        self,
        name: str,
        listener: socket.socket,
        welcome: Welcome,
        tell: Callable[[events.Event], None],
        refused: Callable[[str, str], None],
    ) -> None:
        self._name = name
        self._listener = listener
        self._welcome = welcome
        self._tell = tell
        self._refused = refused
        self._inside: set[asyncio.Task[None]] = set()
        self._strangers: dict[asyncio.Task[None], str] = {}  # their addresses, in order of arrival
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
        turns = Turns(asyncio.get_running_loop().time)
        while True:
            try:
                came_in = await self._accept(turns)
            except Exception as error:
                failures += 1
                again_s = durations.pause_s(failures, _AGAIN_S)
                self._tell(port_events.PortFailed(self._name, str(error), again_s))
                await asyncio.sleep(again_s)
                continue
            if failures:
                failures = 0
                self._tell(port_events.PortOpen(self._name))
            await asyncio.sleep(_PAUSE_S if came_in else _TURN_AWAY_S)

    async def _accept(self, turns: Turns) -> bool:
        connection, peer = await asyncio.get_running_loop().sock_accept(self._listener)
        address = (
            str(peer[0]) if isinstance(peer, tuple) else ""
        )  # clients of a socket file have none
        if address and not turns.take(address):
            self._turn_away(connection, address, "connects too often")
            return False
        if not self._room_for(address):
            self._turn_away(connection, address, "too many connections")
            return True
        task = asyncio.create_task(self._look_after(connection), name=f"port {self._name} client")
        self._inside.add(task)
        if address:  # the kernel identifies the others
            self._strangers[task] = address
        task.add_done_callback(self._gone)
        return True

    def _turn_away(self, connection: socket.socket, address: str, reason: str) -> None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        connection.close()
        self._refused(f"{self._name}:{address}", reason)

    def _room_for(self, address: str) -> bool:
        """Whether a newcomer may enter; drops the longest waiting stranger of a crowded address if
        needed.
        """
        each = Counter(self._strangers.values())
        crowded = each[address] >= _STRANGERS_EACH
        if not crowded and len(self._strangers) < _STRANGERS_MOST:
            return len(self._inside) < _INSIDE_MOST
        most = address if crowded else each.most_common(1)[0][0]
        task = next(task for task, other in self._strangers.items() if other == most)
        del self._strangers[task]
        task.cancel()
        self._refused(f"{self._name}:{most}", "did not identify itself, and others wait")
        return len(self._inside) <= _INSIDE_MOST

    def _gone(self, task: asyncio.Task[None]) -> None:
        self._inside.discard(task)
        self._strangers.pop(task, None)

    async def _look_after(self, connection: socket.socket) -> None:
        task = asyncio.current_task()
        assert task is not None
        try:
            await self._welcome(connection, lambda: self._strangers.pop(task, None))
        except Exception as error:  # one client's error must not affect the others
            self._tell(port_events.PortFailed(self._name, f"{type(error).__name__}: {error}"))
        finally:
            connection.close()


# Refusals are recorded, but cannot fill the record: ten mistakes all appear; of a flood, one in ten
# seconds, with the count of the others
_REFUSAL_BURST = 10.0
_REFUSALS_PER_S = 0.1


class Refusals:
    """Records refusals at the rate of a token bucket; `count` counts all."""

    def __init__(self, tell: Callable[[events.Event], None], now: Callable[[], float]) -> None:
        self._tell, self._now = tell, now
        self._left, self._since_s = _REFUSAL_BURST, now()
        self._unsaid = 0
        self.count = 0

    def record(self, who: str, command: str, reason: str, why: str = "") -> None:
        """Count a refusal, and record it if the rate allows."""
        self.count += 1
        now_s = self._now()
        self._left = min(_REFUSAL_BURST, self._left + _REFUSALS_PER_S * (now_s - self._since_s))
        self._since_s = now_s
        if self._left < 1.0:
            self._unsaid += 1
            return
        self._left -= 1.0
        self._tell(
            port_events.Refused(who, command, why, reason, and_unrecorded=self._unsaid or None)
        )
        self._unsaid = 0
