"""The requests of one connection from their arrival to their answers: safety commands overtake all
others.

A client may send faster than the run can obey. All lines are read as they arrive, because a safety
command may stand behind any number of others. Then

1. a safety command is executed at once; the same command twice waits once, and both senders get its
   answer;
2. the others are executed one after the other, ten a second, and at most `_ORDINARY_MOST` of them
   wait;
3. a request for which there is no room is refused at once, with an answer to its sender.

Reading costs the ticks time. The connections read in turn (`ReadingTurns`), a bounded number of
lines in each turn.
"""

from __future__ import annotations

import asyncio
import re
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from membrane_ctrl.control_port.fair_queue import FairQueue
from membrane_ctrl.control_port.line_connection import LineConnection
from membrane_ctrl.control_port.protocol import Request, RequestError, parse
from membrane_ctrl.control_port.safety_commands import is_safety_command, may_hold_safety_command

_PAUSE_S = 0.1  # after an ordinary request: all requests together cost less than a tick in fifty
# after a safety command: with five kinds of them, each is executed within 0.4 s
_SAFETY_PAUSE_S = 0.05
_ORDINARY_MOST = 16  # requests that wait, for at most 1.6 s
_SAFETY_MOST_EACH = 4  # different requests of one kind that wait, e.g. with different texts
# A program that sends this many invalid requests in a row will not stop
_NONSENSE_MOST = 10
_TURN_S = 0.005
_PARSED_MOST = 8  # lines parsed in a turn: 0.3 ms of each 5 ms
_UNREAD_MOST = 1 << 18  # bytes; beyond, refusals are counted instead of sent one by one

_NUMBER = re.compile(rb'"number"\s*:\s*(\d{1,16})\s*[,}]')

Message = dict[str, Any]
AnswerRequest = Callable[[Request], Awaitable[Message]]
ReadLines = Callable[[], Awaitable[list[bytes] | None]]
RecordRefusal = Callable[[str, str], None]  # command and reason

ReadingTurns = asyncio.Lock


@dataclass(slots=True)
class WaitingSafetyCommand:
    """A safety command with the numbers of all requests that ask for it."""

    request: Request
    numbers: list[int]


class RequestIntake:
    """Reads, orders and answers the requests of one connection.

    Parameters
    ----------
    connection : LineConnection
        Where the answers go.
    answer : callable
        Executes a request and returns its answer.
    record_refusal : callable
        Records a request that was not executed.
    turns : ReadingTurns
        Common to all connections of the port.
    """

    def __init__(
        self,
        connection: LineConnection,
        answer: AnswerRequest,
        record_refusal: RecordRefusal,
        turns: ReadingTurns,
    ) -> None:
        self._connection = connection
        self._answer = answer
        self._record_refusal = record_refusal
        self._turns = turns
        self._ordinary: deque[Request] = deque()
        self._safety: FairQueue[WaitingSafetyCommand] = FairQueue(_SAFETY_MOST_EACH)
        self._arrived = asyncio.Event()  # wakes the task that executes ordinary requests
        self._safety_arrived = asyncio.Event()
        self._ending = False
        self._nonsense = 0
        self._unreported = 0

    async def serve(self, read_lines: ReadLines) -> None:
        """Serve until the peer has gone and everything that it sent is answered.

        Raises RequestError for a peer that sends nonsense; its safety commands are executed first.
        """
        reading = asyncio.create_task(self._read(read_lines), name="port reading")
        workers = (
            asyncio.create_task(self._serve_ordinary(), name="port requests"),
            asyncio.create_task(self._serve_safety(), name="port safety commands"),
        )
        try:
            await asyncio.wait({reading, *workers}, return_when=asyncio.FIRST_COMPLETED)
            if reading.done():
                # The peer has gone, or sends nonsense: then only its safety commands are still
                # executed.
                if reading.exception() is not None:
                    self._ordinary.clear()
                self._ending = True
                self._arrived.set()
                self._safety_arrived.set()
                await asyncio.gather(*workers)
                reading.result()
            for worker in workers:
                if worker.done():
                    worker.result()
        finally:
            for task in (reading, *workers):
                task.cancel()
            await asyncio.gather(reading, *workers, return_exceptions=True)

    def refuse_waiting(self, winner: str) -> None:
        """Refuse the waiting commands that could undo the safety command `winner`, which came after
        them.
        """
        kept = [request for request in self._ordinary if not _can_undo(request)]
        refused = [request for request in self._ordinary if _can_undo(request)]
        self._ordinary.clear()
        self._ordinary.extend(kept)
        for request in refused:
            self._refuse(
                request.do,
                request.number,
                f"{winner} came meanwhile and takes precedence; send again",
            )

    async def _read(self, read_lines: ReadLines) -> None:
        while (arrived := await read_lines()) is not None:
            lines = deque(arrived)
            while lines:
                async with self._turns:
                    self._accept_some(lines)
                    await asyncio.sleep(_TURN_S)

    def _accept_some(self, lines: deque[bytes]) -> None:
        """Accept lines until the turn's share of parsing is used.

        While the queue is full, only a line that could hold a safety command is parsed: a search
        for a few words costs far less than JSON.
        """
        parsed = 0
        while lines and parsed < _PARSED_MOST:
            line = lines.popleft()
            crowded = len(self._ordinary) >= _ORDINARY_MOST
            if crowded and not may_hold_safety_command(line):
                self._refuse_unread(line)
            else:
                self._accept(line)
                parsed += 1

    def _accept(self, line: bytes) -> None:
        """Parse a request and put it into its queue."""
        try:
            request = parse(line)
        except RequestError as error:
            self._nonsense += 1
            if self._nonsense > _NONSENSE_MOST:
                raise
            self._refuse("", error.number, str(error))
            return
        self._nonsense = 0
        if is_safety_command(request.do):
            self._accept_safety(request)
        elif len(self._ordinary) < _ORDINARY_MOST:
            self._ordinary.append(request)
            self._arrived.set()
        else:
            self._refuse(request.do, request.number, _too_many(_ORDINARY_MOST))

    def _accept_safety(self, request: Request) -> None:
        """Queue a safety command, or add its number to an equal one that waits already."""
        # The same command may already wait: one execution answers both.
        for waiting in self._safety.waiting_of(request.do):
            if (waiting.request.text, waiting.request.take_over) == (
                request.text,
                request.take_over,
            ):
                waiting.numbers.append(request.number)
                return
        if self._safety.put(request.do, WaitingSafetyCommand(request, [request.number])):
            self._safety_arrived.set()
        else:
            self._refuse(
                request.do,
                request.number,
                f"{_SAFETY_MOST_EACH} of its kind wait already; send again",
            )

    async def _serve_ordinary(self) -> None:
        while True:
            await self._arrived.wait()
            if not self._ordinary:
                if self._ending:
                    return
                self._arrived.clear()
                continue
            request = self._ordinary.popleft()
            answer = await self._answer(request)
            self._connection.send({"number": request.number, **answer})
            await asyncio.sleep(_PAUSE_S)

    async def _serve_safety(self) -> None:
        while True:
            await self._safety_arrived.wait()
            waiting = self._safety.take()
            if waiting is None:
                if self._ending:
                    return
                self._safety_arrived.clear()
                continue
            answer = await self._answer(waiting.request)
            for number in waiting.numbers:
                self._connection.send({"number": number, **answer})
            await asyncio.sleep(_SAFETY_PAUSE_S)

    def _refuse_unread(self, line: bytes) -> None:
        """Refuse a line of a flood without parsing it."""
        found = _NUMBER.search(line)
        number = int(found.group(1)) if found else 0
        self._refuse("", number, _too_many(_ORDINARY_MOST))

    def _refuse(self, command: str, number: int, reason: str) -> None:
        self._record_refusal(command, reason)
        # A client that sends a flood without reading must not lose its connection by the answers to
        # it.
        if self._connection.unread_bytes > _UNREAD_MOST:
            self._unreported += 1
            return
        if self._unreported:
            self._connection.send(
                {"notice": f"{self._unreported} more requests were refused: {reason}"}
            )
            self._unreported = 0
        self._connection.send({"number": number, "ok": False, "refused": reason})


def _too_many(most: int) -> str:
    return f"not executed: {most} other requests of this connection wait; send it again later"


def _can_undo(request: Request) -> bool:
    """Whether a request is one that moves the mirror or changes how it is moved."""
    return request.do not in {"status", "watch", "release", "quiet", "mark"}
