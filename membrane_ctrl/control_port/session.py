"""One client of the port from greeting to goodbye."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import Awaitable, Callable
from typing import Any

from membrane_ctrl.control_port.answers import COMMAND_TAKEN
from membrane_ctrl.control_port.line_connection import LineConnection, SlowReaderError
from membrane_ctrl.control_port.protocol import Request, RequestError
from membrane_ctrl.control_port.request_intake import ReadingTurns, RequestIntake
from membrane_ctrl.control_port.sender import Peer
from membrane_ctrl.model.events import Event

Answer = Callable[["PortSession", Request], Awaitable[dict[str, Any]]]
Refused = Callable[[str, str, str], None]


class PortSession:
    """A connection whose peer is known; `watch` streams `status`."""

    def __init__(
        self,
        connection: LineConnection,
        peer: Peer,
        status: Callable[[], dict[str, Any]],
        turns: ReadingTurns,
    ) -> None:
        self.peer = peer
        self.id = secrets.token_hex(4)  # of the connection
        self.heard_s = asyncio.get_running_loop().time()  # time of the peer's last request
        self._connection = connection
        self._status = status
        self._turns = turns
        self._intake: RequestIntake | None = None
        self._watch: asyncio.Task[None] | None = None

    async def run(self, greeting: dict[str, Any], answer: Answer, refused: Refused) -> None:
        """Answer requests until the peer disconnects; in the event loop of the ticks.

        Parameters
        ----------
        greeting : dict
            First message to the peer: version, run, its name and role, the commander, the run's
            clock.
        answer : async callable
            Executes a request of this session and returns its answer.
        refused : callable
            Records a refusal: who, command (empty for the connection itself), reason.
        """
        try:
            self._connection.send(greeting)
            await self._serve_requests(answer, refused)
        except SlowReaderError as error:
            refused(self.peer.who, "", str(error))
        except RequestError as error:
            refused(self.peer.who, "", str(error))
            with contextlib.suppress(SlowReaderError):
                self._connection.send({"number": 0, "ok": False, "refused": str(error)})
        finally:
            self.watch(None)
            await self._connection.close()

    async def _serve_requests(self, answer: Answer, refused: Refused) -> None:
        async def answer_request(request: Request) -> dict[str, Any]:
            return await answer(self, request)

        async def read_lines() -> list[bytes] | None:
            lines = await self._connection.lines()
            self.heard_s = asyncio.get_running_loop().time()
            return lines

        def record_refusal(command: str, reason: str) -> None:
            refused(self.peer.who, command, reason)

        self._intake = RequestIntake(self._connection, answer_request, record_refusal, self._turns)
        await self._intake.serve(read_lines)

    def refuse_waiting(self, winner: str) -> None:
        """Refuse the waiting commands that could undo the safety command `winner`."""
        if self._intake is not None:
            with contextlib.suppress(SlowReaderError):
                self._intake.refuse_waiting(winner)

    def notice(self, text: str) -> None:
        """Send an unsolicited notice."""
        with contextlib.suppress(SlowReaderError):
            self._connection.send({"notice": text})

    def command_taken(self, text: str) -> None:
        """Send the notice that this connection has lost command to another."""
        with contextlib.suppress(SlowReaderError):
            self._connection.send({"notice": text, "code": COMMAND_TAKEN})

    def event(self, event: Event) -> None:
        """Send an event to a watching peer."""
        if self._watch is not None:
            with contextlib.suppress(SlowReaderError):
                self._connection.send({"event": event.to_dict()})

    def watch(self, period_s: float | None) -> None:
        """Stream the status from now on; None ends it."""
        if self._watch is not None:
            self._watch.cancel()
        if period_s is None:
            self._watch = None
        else:
            self._watch = asyncio.create_task(self._stream(period_s), name="port watch")

    async def _stream(self, period_s: float) -> None:
        with contextlib.suppress(SlowReaderError):
            while True:
                await asyncio.sleep(period_s)
                self._connection.send({"status": self._status()})

    def drop(self, why: str) -> None:
        """End the connection with a last message."""
        self.notice(why)
        self._connection.abort()
