"""The commands of all bridges on their way to the hold: two lanes, bounded in number and in time.

Safety commands have a lane of their own. They are sent at once, the kinds in turn, and the same
command that comes again while it waits shares the answer. Their answer comes within
`SAFETY_ANSWER_S`; a hold that has not answered by then gets the command as soon as it can.

All other commands wait in one queue of at most `ORDINARY_MOST`, and are refused `TIME_LIMIT_S`
after their arrival: a `hold` that is obeyed a minute later is dangerous. A safety command also
refuses those that wait, because they came before it and would undo it.

There is one connection a lane: the control port drops connections of a user that has too many.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from membrane_ctrl.control_port.fair_queue import FairQueue
from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.control_port.safety_commands import is_safety_command
from membrane_ctrl.service.hold_command import NO_LIMITS
from membrane_ctrl.service.send_limits import SendLimits

ORDINARY_MOST = 8  # commands that wait
SAFETY_MOST_EACH = 4  # different safety commands of one kind that wait
TIME_LIMIT_S = 2.0
SAFETY_ANSWER_S = 0.9
_SHARED_MOST = 64  # senders that share the answer to one safety command

Message = dict[str, Any]
SendCommand = Callable[[Message, SendLimits], Outcome]
ReportLate = Callable[[Outcome], None]

MOVES_NOTHING = frozenset({"mark", "quiet"})


@dataclass(slots=True, eq=False)
class WaitingCommand:
    """A command with the futures of its senders."""

    request: Message
    deadline_s: float
    outcomes: list[asyncio.Future[Outcome]] = field(default_factory=list)

    @property
    def kind(self) -> str:
        """Name of the command."""
        return str(self.request["do"])

    @property
    def answered(self) -> bool:
        """Whether all senders have an answer."""
        return all(outcome.done() for outcome in self.outcomes)

    def answer(self, result: Outcome) -> None:
        """Answer all senders that have no answer yet."""
        for outcome in self.outcomes:
            if not outcome.done():
                outcome.set_result(result)


class CommandLanes:
    """Sends the commands of all bridges of this process.

    Parameters
    ----------
    send : callable
        Sends one command and returns what became of it; blocking, called on threads.
    report_late : callable
        Gets the outcome of a safety command whose senders were already answered.
    """

    def __init__(self, send: SendCommand, report_late: ReportLate) -> None:
        self._send = send
        self._report_late = report_late
        self._ordinary: deque[WaitingCommand] = deque()
        self._safety: FairQueue[WaitingCommand] = FairQueue(SAFETY_MOST_EACH)
        self._ordinary_task: asyncio.Task[None] | None = None
        self._safety_task: asyncio.Task[None] | None = None
        self._newest_safety = ""
        self._safety_count = 0

    def submit(self, request: Message) -> asyncio.Future[Outcome]:
        """Accept or refuse a command at once; the future holds what became of it."""
        outcome: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        if is_safety_command(str(request["do"])):
            self._submit_safety(request, outcome)
        else:
            self._submit_ordinary(request, outcome)
        return outcome

    async def close(self) -> None:
        """End; safety commands under way have until their answer is due."""
        if self._safety_task is not None:
            await asyncio.wait({self._safety_task}, timeout=SAFETY_ANSWER_S)
        tasks = [task for task in (self._safety_task, self._ordinary_task) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _submit_ordinary(self, request: Message, outcome: asyncio.Future[Outcome]) -> None:
        kind = str(request["do"])
        if len(self._ordinary) >= ORDINARY_MOST:
            outcome.set_result(
                Outcome.refused(kind, f"too many commands at once: {ORDINARY_MOST} wait already")
            )
            return
        waiting = WaitingCommand(request, time.monotonic() + TIME_LIMIT_S, [outcome])
        late = Outcome.refused(
            kind, f"not obeyed within {TIME_LIMIT_S:g} s, and will not be later; send again"
        )
        asyncio.get_running_loop().call_later(TIME_LIMIT_S, waiting.answer, late)
        self._ordinary.append(waiting)
        if self._ordinary_task is None or self._ordinary_task.done():
            self._ordinary_task = asyncio.create_task(
                self._serve_ordinary(), name="bridge commands"
            )

    def _submit_safety(self, request: Message, outcome: asyncio.Future[Outcome]) -> None:
        kind = str(request["do"])
        self._refuse_waiting(kind)
        asyncio.get_running_loop().call_later(SAFETY_ANSWER_S, _answer_provisionally, outcome, kind)
        # The same command with the same text may already wait: sending it once answers both.
        for waiting in self._safety.waiting_of(kind):
            if waiting.request.get("text") == request.get("text"):
                if len(waiting.outcomes) < _SHARED_MOST:
                    waiting.outcomes.append(outcome)
                else:
                    shared = f"the same command of {_SHARED_MOST} others is being sent"
                    outcome.set_result(Outcome.failed(kind, shared))
                return
        waiting = WaitingCommand(request, float("inf"), [outcome])
        if not self._safety.put(kind, waiting):
            full = f"{SAFETY_MOST_EACH} with other texts wait already; send again"
            outcome.set_result(Outcome.refused(kind, full))
            return
        if self._safety_task is None or self._safety_task.done():
            self._safety_task = asyncio.create_task(
                self._serve_safety(), name="bridge safety commands"
            )

    def _refuse_waiting(self, winner: str) -> None:
        """Refuse the waiting commands that came before a safety command and could undo it."""
        self._newest_safety = winner
        self._safety_count += 1
        for waiting in self._ordinary:
            if waiting.kind not in MOVES_NOTHING:
                waiting.answer(Outcome.refused(waiting.kind, overtaken(winner)))

    async def _serve_ordinary(self) -> None:
        while self._ordinary:
            waiting = self._ordinary.popleft()
            if waiting.answered:  # refused while it waited
                continue
            limits = SendLimits(waiting.deadline_s, self._make_overtaken_check(waiting.kind))
            waiting.answer(await self._send_on_thread(waiting.request, limits))

    def _make_overtaken_check(self, kind: str) -> Callable[[], str]:
        """A function that returns why a command must not be sent any more: a safety command has
        come since now; else an empty text.
        """
        count = self._safety_count

        def refusal() -> str:
            if kind in MOVES_NOTHING or self._safety_count == count:
                return ""
            return overtaken(self._newest_safety)

        return refusal

    async def _serve_safety(self) -> None:
        while (waiting := self._safety.take()) is not None:
            outcome = await self._send_on_thread(waiting.request, NO_LIMITS)
            if waiting.answered:
                self._report_late(outcome)
            waiting.answer(outcome)

    async def _send_on_thread(self, request: Message, limits: SendLimits) -> Outcome:
        """Send on a new thread that ends with the process: a hold that hangs must not delay the
        exit.
        """
        loop = asyncio.get_running_loop()
        outcome: asyncio.Future[Outcome] = loop.create_future()

        def set_outcome(result: Outcome) -> None:
            if not outcome.done():
                outcome.set_result(result)

        def send() -> None:
            try:
                result = self._send(request, limits)
            except Exception as error:  # nothing else would see an exception of this thread
                result = Outcome.failed(
                    str(request["do"]), f"not sent: {type(error).__name__}: {error}"
                )
            with contextlib.suppress(RuntimeError):  # the loop is closed, no sender waits
                loop.call_soon_threadsafe(set_outcome, result)

        threading.Thread(target=send, name="bridge command", daemon=True).start()
        return await outcome


def _answer_provisionally(outcome: asyncio.Future[Outcome], kind: str) -> None:
    if not outcome.done():
        late = f"no answer from the hold within {SAFETY_ANSWER_S:g} s; still being sent"
        outcome.set_result(Outcome.failed(kind, late))


def overtaken(winner: str) -> str:
    """Why a command is refused that came before the safety command `winner`, and would undo it."""
    return f"{winner} came meanwhile and takes precedence; send again"
