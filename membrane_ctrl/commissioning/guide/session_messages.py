"""A session as messages: what the page's service gets from it, and sends back.

The session runs in a program of its own (`commission FOLDER --messages`). It writes one JSON object
a line; each question has a number. It reads one JSON object a line, an answer with the number of
its question. An answer to any other question is dropped: a confirmation acts once, however often a
browser sends it.
"""

import queue
import signal
import threading
from collections.abc import Callable
from typing import Annotated, Literal, TextIO

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from membrane_ctrl.commissioning.guide.dialogue import (
    Question,
    SessionDisplay,
    StageHead,
    StageProgress,
)
from membrane_ctrl.commissioning.guide.session_state import CheckRecord


class LineMessage(BaseModel):
    """A line for people."""

    kind: Literal["line"] = "line"
    text: str


class StageMessage(BaseModel):
    """A stage begins."""

    kind: Literal["stage"] = "stage"
    stage: StageHead


class PlanMessage(BaseModel):
    """All stages, whenever one has changed."""

    kind: Literal["plan"] = "plan"
    plan: tuple[StageProgress, ...]


class CheckMessage(BaseModel):
    """A check was made."""

    kind: Literal["check"] = "check"
    check: CheckRecord


class QuestionMessage(BaseModel):
    """A question waits for its answer."""

    kind: Literal["question"] = "question"
    number: int
    question: Question


class EndMessage(BaseModel):
    """The session has ended, with the exit code of its program.

    Attributes
    ----------
    code : int
        As in `errors.Exit`.
    problem : str
        Of an end by an error, in one line.
    """

    kind: Literal["end"] = "end"
    code: int
    problem: str = ""


SessionMessage = Annotated[
    LineMessage | PlanMessage | StageMessage | CheckMessage | QuestionMessage | EndMessage,
    Field(discriminator="kind"),
]
MESSAGES: TypeAdapter[SessionMessage] = TypeAdapter(SessionMessage)


class BeginMessage(BaseModel):
    """The first line to a session that systemd has started: its name below the folder of all."""

    model_config = ConfigDict(extra="forbid")

    session: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")


class AnswerMessage(BaseModel):
    """An answer to the question of a number."""

    model_config = ConfigDict(extra="forbid")

    number: int
    answer: str


def hear_interrupts() -> None:
    """Let SIGINT end this program as Ctrl-C does.

    A shell lets what it starts in the background ignore SIGINT, and so does every program that is
    started from there: the service, and the session, whose stop would not be heard.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)


class MessageDisplay(SessionDisplay):
    """Writes messages, and waits for answers.

    Parameters
    ----------
    source, target : file
        Where answers are read from, and messages are written to.
    interrupt : callable
        Called once the source has ended: the service is gone, and the session stops at once.
    """

    def __init__(self, source: TextIO, target: TextIO, interrupt: Callable[[], None]) -> None:
        self._source = source
        self._target = target
        self._interrupt = interrupt
        self._number = 0
        self._answers: queue.SimpleQueue[AnswerMessage | None] = queue.SimpleQueue()
        threading.Thread(target=self._read_answers, daemon=True).start()

    def show_line(self, line: str) -> None:
        """Send a line."""
        self._send(LineMessage(text=line))

    def show_plan(self, plan: tuple[StageProgress, ...]) -> None:
        """Send the list of stages."""
        self._send(PlanMessage(plan=plan))

    def show_stage(self, stage: StageHead) -> None:
        """Send that a stage begins."""
        self._send(StageMessage(stage=stage))

    def show_check(self, check: CheckRecord) -> None:
        """Send a check."""
        self._send(CheckMessage(check=check))

    def ask_question(self, question: Question) -> str:
        """Send a question and wait for its answer. Raises EOFError if none can come."""
        self._number += 1
        self._send(QuestionMessage(number=self._number, question=question))
        while True:
            given = self._answers.get()
            if given is None:
                raise EOFError
            if given.number == self._number:
                return given.answer

    def show_end(self, code: int, problem: str = "") -> None:
        """Send that the session has ended.

        Parameters
        ----------
        code : int
            Exit code of the program (`errors.Exit`).
        problem : str
            What it would print on a terminal; empty without a problem.
        """
        self._send(EndMessage(code=code, problem=problem))

    def _send(self, message: BaseModel) -> None:
        print(message.model_dump_json(), file=self._target, flush=True)

    def _read_answers(self) -> None:
        for line in self._source:
            try:
                self._answers.put(AnswerMessage.model_validate_json(line))
            except ValidationError:
                continue
        self._answers.put(None)
        self._interrupt()
