"""A listening socket in the control process: lets in few at a time, and reopens after a failure.

`asyncio.start_server` would accept all connections at once; here each waits for the one before, so that a flood costs
the tick no more than twenty handshakes a second.

A peer that has not identified itself (no handshake, no request) is a stranger. The number of strangers is limited,
per address as well: the longest waiting one makes room for a newcomer, so that nobody can block the queue. An address
that comes too often is turned away at once.
"""

import asyncio
import socket
import struct
from collections import Counter, OrderedDict
from collections.abc import Awaitable, Callable

from membrane_ctrl.model import clock, events, run_events

BACKLOG = 64  # who waits while another comes in; the kernel turns away the rest
_INSIDE_MOST = 32
_STRANGERS_MOST, _STRANGERS_EACH = 16, 4
_PAUSE_S = 0.05
# Of one address: a person's terminal and a script or two; a flood gets a tenth of the handshakes
_BURST, _PER_S = 10.0, 2.0
_TURN_AWAY_S = 0.005  # costs 50 us: a hundredth of a processor
_ADDRESSES_MOST = 1024  # remembered
_LEAVE_S = 2.0  # then the run ends without them
_AGAIN_S = 1.0
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER: what is turned away leaves nothing behind in the kernel

LetIn = Callable[[], object]
Welcome = Callable[[socket.socket, LetIn], Awaitable[None]]


class Turns:
    """How often an address may come: a token bucket each; the address that has been away longest is forgotten."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, address: str) -> bool:
        """Whether it may come in now; then it has come."""
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
        Gets who was refused, and why.
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
        self._strangers: dict[asyncio.Task[None], str] = {}  # and their addresses, in the order they came
        self._task: asyncio.Task[None] | None = None

    def open(self) -> None:
        """Begin to accept."""
        self._task = asyncio.create_task(self._keep(), name=f"port {self._name}")

    async def close(self) -> None:
        """End everything behind the endpoint."""
        tasks = [*self._inside, *([self._task] if self._task else [])]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks, timeout=_LEAVE_S)
        self._listener.close()

    async def _keep(self) -> None:
        """Accept for ever; report a failure and try again."""
        failures = 0
        turns = Turns(asyncio.get_running_loop().time)
        while True:
            try:
                came_in = await self._accept(turns)
            except Exception as error:
                failures += 1
                again_s = clock.pause_s(failures, _AGAIN_S)
                self._tell(run_events.PortFailed(self._name, str(error), again_s))
                await asyncio.sleep(again_s)
                continue
            if failures:
                failures = 0
                self._tell(run_events.PortOpen(self._name))
            await asyncio.sleep(_PAUSE_S if came_in else _TURN_AWAY_S)

    async def _accept(self, turns: Turns) -> bool:
        connection, peer = await asyncio.get_running_loop().sock_accept(self._listener)
        address = str(peer[0]) if isinstance(peer, tuple) else ""  # who comes by a socket file has none
        if address and not turns.take(address):
            self._turn_away(connection, address, "comes too often")
            return False
        if not self._room_for(address):
            self._turn_away(connection, address, "too many are inside")
            return True
        task = asyncio.create_task(self._look_after(connection), name=f"port {self._name} client")
        self._inside.add(task)
        if address:  # the kernel names the others
            self._strangers[task] = address
        task.add_done_callback(self._gone)
        return True

    def _turn_away(self, connection: socket.socket, address: str, reason: str) -> None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        connection.close()
        self._refused(f"{self._name}:{address}", reason)

    def _room_for(self, address: str) -> bool:
        """Whether a newcomer may come in; the longest waiting stranger of a crowded address goes for it."""
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
        except Exception as error:  # one client's trouble is nobody else's
            self._tell(run_events.PortFailed(self._name, f"{type(error).__name__}: {error}"))
        finally:
            connection.close()


# Refusals are recorded, but nobody can fill the record with them: ten mistakes are all there; of a flood one in ten
# seconds, with the count of the others
_REFUSAL_BURST = 10.0
_REFUSALS_PER_S = 0.1


class Refusals:
    """Records refusals as a token bucket allows; `count` counts all."""

    def __init__(self, tell: Callable[[events.Event], None], now: Callable[[], float]) -> None:
        self._tell, self._now = tell, now
        self._left, self._since_s = _REFUSAL_BURST, now()
        self._unsaid = 0
        self.count = 0

    def record(self, who: str, command: str, reason: str, why: str = "") -> None:
        """Count a refusal, and record it if the bucket allows."""
        self.count += 1
        now_s = self._now()
        self._left = min(_REFUSAL_BURST, self._left + _REFUSALS_PER_S * (now_s - self._since_s))
        self._since_s = now_s
        if self._left < 1.0:
            self._unsaid += 1
            return
        self._left -= 1.0
        self._tell(run_events.Refused(who, command, why, reason, and_unrecorded=self._unsaid or None))
        self._unsaid = 0
