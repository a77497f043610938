"""One client from greeting to goodbye."""

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from membrane_ctrl.control_port.protocol import Action, Request, RequestError, SlowReaderError, Wire, parse
from membrane_ctrl.controller.commands import TABLE, Role
from membrane_ctrl.model.events import Event

_RANK: dict[Role, int] = {"read": 0, "operate": 1, "tune": 2}
_ERRANDS: dict[str, Role] = {"status": "read", "watch": "read", "release": "operate", "quiet": "operate"}

# These need no command: stopping the pump is always accepted, and the others move nothing
FREE = frozenset({"status", "watch", "stop", "latch", "mark", "release", "quiet"})


@dataclass(frozen=True, slots=True)
class Peer:
    """The peer of a connection: `unix:NAME` or `tls:NAME`, as given by the system or a certificate."""

    who: str
    role: Role


def may_not(peer: Peer, do: Action) -> str:
    """Why the peer's role forbids this request; empty if it does not."""
    needed = TABLE[do].role if do in TABLE else _ERRANDS[do]
    if _RANK[peer.role] >= _RANK[needed]:
        return ""
    return f"{do} needs the role {needed}; {peer.who} has {peer.role}"


class Commander:
    """One commander at a time: the first client to command, until it releases or loses command or idles too long."""

    def __init__(self, lapses_s: float) -> None:
        self._lapses_s = lapses_s
        self._holder = ""
        self._last_s = -math.inf

    def holder(self, now_s: float) -> str:
        """Who has command; empty if nobody."""
        return self._holder if now_s - self._last_s <= self._lapses_s else ""

    def claim(self, who: str, take_over: bool, now_s: float) -> str:
        """Take or keep command; returns why not, or an empty text."""
        holder = self.holder(now_s)
        if holder not in ("", who) and not take_over:
            return f"{holder} has command; take over with --take-over, or wait for its release"
        self._holder, self._last_s = who, now_s
        return ""

    def release(self, who: str) -> None:
        """Release command, if `who` has it."""
        if self._holder == who:
            self._holder = ""


# A client that sends faster is read more slowly: all requests together cost less than a tick in fifty
_PAUSE_S = 0.1
# A program that sends this many invalid requests in a row will not stop
_NONSENSE_MOST = 10

Answer = Callable[["PortSession", Request], Awaitable[dict[str, Any]]]
Refused = Callable[[str, str, str], None]


class PortSession:
    """A connection whose peer is known; `watch` streams `status`."""

    def __init__(self, wire: Wire, peer: Peer, status: Callable[[], dict[str, Any]]) -> None:
        self.peer = peer
        self.heard_s = asyncio.get_running_loop().time()  # time of the peer's last request
        self._wire = wire
        self._status = status
        self._watch: asyncio.Task[None] | None = None

    async def run(self, greeting: dict[str, Any], answer: Answer, refused: Refused) -> None:
        """Answer requests until the peer disconnects."""
        try:
            self._wire.send(greeting)
            await self._converse(answer, refused)
        except SlowReaderError as error:
            refused(self.peer.who, "", str(error))
        except RequestError as error:
            refused(self.peer.who, "", str(error))
            with contextlib.suppress(SlowReaderError):
                self._wire.send({"number": 0, "ok": False, "refused": str(error)})
        finally:
            self.watch(None)
            await self._wire.close()

    async def _converse(self, answer: Answer, refused: Refused) -> None:
        nonsense = 0
        while (line := await self._wire.line()) is not None:
            self.heard_s = asyncio.get_running_loop().time()
            try:
                request = parse(line)
            except RequestError as error:
                nonsense += 1
                if nonsense > _NONSENSE_MOST:
                    raise
                refused(self.peer.who, "", str(error))
                self._wire.send({"number": error.number, "ok": False, "refused": str(error)})
            else:
                nonsense = 0
                self._wire.send({"number": request.number, **await answer(self, request)})
            await asyncio.sleep(_PAUSE_S)

    def notice(self, text: str) -> None:
        """Send an unsolicited notice."""
        with contextlib.suppress(SlowReaderError):
            self._wire.send({"notice": text})

    def event(self, event: Event) -> None:
        """Send an event to a watching peer."""
        if self._watch is not None:
            with contextlib.suppress(SlowReaderError):
                self._wire.send({"event": event.to_dict()})

    def watch(self, period_s: float | None) -> None:
        """Stream the status from now on; None ends it."""
        if self._watch is not None:
            self._watch.cancel()
        self._watch = None if period_s is None else asyncio.create_task(self._stream(period_s), name="port watch")

    async def _stream(self, period_s: float) -> None:
        with contextlib.suppress(SlowReaderError):
            while True:
                await asyncio.sleep(period_s)
                self._wire.send({"status": self._status()})

    def drop(self, why: str) -> None:
        """End the connection with a last message."""
        self.notice(why)
        self._wire.abort()
