"""Questions to the person at the bench. `back` and `quit` are accepted as every answer."""

import math
import re
from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import TypeVar

from pydantic import BaseModel, ConfigDict

from membrane_ctrl.commissioning.guide.session_state import CheckRecord

T = TypeVar("T")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+(\.\d*)?")  # 1,103 is 1.103 or 1103
BACK, QUIT = "back", "quit"
# Accepted as well where no text is asked for: an interlock may be named `stop`
_SHORT_BACK, _STOP = "b", "stop"


class GoBackError(Exception):
    """The person wants to return to the previous stage."""


class StopSessionError(Exception):
    """The person wants to stop, and to resume later."""


class Choice(BaseModel):
    """An entry of a numbered list."""

    model_config = ConfigDict(frozen=True)

    name: str
    meaning: str = ""


class QuestionKind(StrEnum):
    """What answers a question."""

    TEXT = "text"
    NUMBER = "number"
    CHOICE = "choice"
    CONFIRMATION = "confirmation"  # `y` or `n`
    READINESS = "readiness"  # anything, once the person has done what is asked


class Question(BaseModel):
    """A question as terminal and page show it.

    Attributes
    ----------
    key : str
        Of the answer in the session's state.
    kind : QuestionKind
        Which form of answer is expected.
    text : str
        For people; of a readiness what they are to do.
    default : str
        The answer if none is typed; empty without one.
    choices : tuple of Choice
        Of a choice; empty for other kinds.
    unit : str
        Of a number.
    low, high : float
        Limits of a number.
    """

    model_config = ConfigDict(frozen=True)

    key: str
    kind: QuestionKind
    text: str
    default: str = ""
    choices: tuple[Choice, ...] = ()
    unit: str = ""
    low: float = 0.0
    high: float = 0.0


class StageHead(BaseModel):
    """A stage that begins."""

    model_config = ConfigDict(frozen=True)

    step: int
    title: str
    name: str
    does: str
    look_for: str


class StageResult(StrEnum):
    """How far a stage is."""

    OPEN = "open"
    PASSED = "passed"
    FAILED = "failed"  # passed by, with a failed check
    NOT_NEEDED = "not needed"  # the bench lacks what it tests


class StageProgress(BaseModel):
    """A stage in the list of all."""

    model_config = ConfigDict(frozen=True)

    step: int
    title: str
    name: str
    result: StageResult


class SessionDisplay:
    """Where a session shows its progress, and from where it gets its answers."""

    def show_line(self, line: str) -> None:
        """Show a line."""
        raise NotImplementedError

    def show_plan(self, plan: tuple[StageProgress, ...]) -> None:
        """Show all stages and how far each is; not shown by default."""

    def show_stage(self, stage: StageHead) -> None:
        """Show that a stage begins."""
        raise NotImplementedError

    def show_check(self, check: CheckRecord) -> None:
        """Show a check."""
        raise NotImplementedError

    def ask_question(self, question: Question) -> str:
        """Return what the person has typed. Raises EOFError at the end of the input."""
        raise NotImplementedError


class Dialogue:
    """Asks, and parses the answers.

    Parameters
    ----------
    display : SessionDisplay
        Shows the questions and returns what is typed.
    remembered : dict
        Typed answers by key: each becomes the default when its question is asked again.
    remember : callable
        Called after each answer, to store them.
    """

    def __init__(
        self,
        display: SessionDisplay,
        remembered: dict[str, str],
        remember: Callable[[], None],
    ) -> None:
        self.display = display
        self._remembered = remembered
        self._remember = remember

    def show(self, *lines: str) -> None:
        """Show lines."""
        for line in lines:
            self.display.show_line(line)

    def ask_text(self, key: str, question: str, default: str = "", is_needed: bool = False) -> str:
        """Ask for a text.

        Parameters
        ----------
        key : str
            Under which the answer is kept.
        question : str
            For the person.
        default : str
            What an empty answer stands for.
        is_needed : bool
            An empty answer without a default is asked again.
        """

        def parse(text: str) -> str:
            if is_needed and not text:
                raise ValueError("an answer is needed; `back` returns")
            return text

        asked = Question(key=key, kind=QuestionKind.TEXT, text=question, default=default)
        return self._ask(asked, parse)

    def ask_number(
        self, key: str, question: str, default: float, low: float, high: float, unit: str = ""
    ) -> float:
        """Ask for a number until it is within limits.

        Parameters
        ----------
        key : str
            Under which the answer is kept.
        question : str
            For the person.
        default : float
            What an empty answer stands for.
        low, high : float
            The limits.
        unit : str
            Of the number.
        """

        def parse(text: str) -> float:
            if _THOUSANDS.fullmatch(text):
                raise ValueError("a comma before three digits has two meanings: write a point")
            try:
                value = float(text.replace(",", "."))
            except ValueError:
                raise ValueError("write a number, such as 37.1") from None
            if not low <= value <= high or not math.isfinite(value):
                raise ValueError(f"must be within {low:g} .. {high:g} {unit}".rstrip())
            return value

        asked = Question(
            key=key,
            kind=QuestionKind.NUMBER,
            text=question,
            default=f"{default:g}",
            unit=unit,
            low=low,
            high=high,
        )
        return self._ask(asked, parse)

    def ask_choice(
        self, key: str, question: str, choices: Sequence[Choice], default: str = ""
    ) -> str:
        """Ask for one of a numbered list; a number or a name is accepted.

        Parameters
        ----------
        key : str
            Under which the answer is kept.
        question : str
            For the person.
        choices : sequence of Choice
            The list.
        default : str
            Name that an empty answer stands for.

        Returns
        -------
        str
            The name of the choice.
        """
        names = [choice.name for choice in choices]

        def parse(text: str) -> str:
            if text in names:
                return text
            if text.isdecimal() and 1 <= int(text) <= len(names):
                return names[int(text) - 1]
            raise ValueError(f"choose a number from 1 to {len(names)}, or a name")

        asked = Question(
            key=key,
            kind=QuestionKind.CHOICE,
            text=question,
            default=default,
            choices=tuple(choices),
        )
        return self._ask(asked, parse)

    def confirm(self, key: str, question: str) -> bool:
        """Ask yes or no; there is no default, because it must be seen each time.

        Parameters
        ----------
        key : str
            Identifies the question to displays and tests; the answer is not kept.
        question : str
            For the person.

        Returns
        -------
        bool
            True for yes.

        Raises
        ------
        GoBackError, StopSessionError
            The person answers `back` or `quit`, as to every question.
        """
        asked = Question(key=key, kind=QuestionKind.CONFIRMATION, text=question)
        while True:
            typed = self._read(asked).lower()
            if typed in ("y", "yes"):
                return True
            if typed in ("n", "no"):
                return False
            self.show("  answer y or n")

    def wait(self, key: str, request: str) -> None:
        """Ask the person to do something and to state that it is done.

        Parameters
        ----------
        key : str
            Identifies the request to displays and tests.
        request : str
            What to do, as an imperative.

        Raises
        ------
        GoBackError, StopSessionError
            The person answers `back` or `quit`.
        """
        self._read(Question(key=key, kind=QuestionKind.READINESS, text=request))

    def _ask(self, asked: Question, parse: Callable[[str], T]) -> T:
        default = self._remembered.get(asked.key, asked.default)
        asked = asked.model_copy(update={"default": default})
        while True:
            typed = self._read(asked)
            try:
                value = parse(typed or default)
            except ValueError as error:
                self.show(f"  {error}")
                continue
            # the value, not what was typed: a number in a list may mean another choice next time
            self._remembered[asked.key] = (
                f"{value:.12g}" if isinstance(value, float) else str(value)
            )
            self._remember()
            return value

    def _read(self, asked: Question) -> str:
        typed = self.display.ask_question(asked).strip()
        is_free = asked.kind == QuestionKind.TEXT
        word = typed.lower()
        if word == BACK or (word == _SHORT_BACK and not is_free):
            raise GoBackError
        if word == QUIT or (word == _STOP and not is_free):
            raise StopSessionError
        return typed
