"""Questions in a row, with a way back, whose answers survive Ctrl-C.

The answers are a list in the order of their questions. `back` drops the last one, and the questions
are asked again from the first: those that have an answer take it without being shown. The list is
in a file until the interview has ended.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from membrane_ctrl.commissioning.guide.dialogue import (
    Dialogue,
    GoBackError,
    Question,
    SessionDisplay,
    StageHead,
    StopSessionError,
)
from membrane_ctrl.commissioning.guide.session_state import CheckRecord
from membrane_ctrl.model import errors, files

T = TypeVar("T")
_SCHEMA = "membrane-interview/1"


class InterviewStoppedError(errors.CommandError):
    """The person has stopped; the answers are kept."""

    exit = errors.Exit.INTERRUPTED


class _AnswerList(SessionDisplay):
    """A display that gives the known answers, and asks and keeps the others."""

    def __init__(self, inner: SessionDisplay, given: list[list[str]], keep: Callable[[], None]):
        self._inner = inner
        self._given = given
        self._keep = keep
        self._asked = 0

    @property
    def _is_replaying(self) -> bool:
        return self._asked < len(self._given)

    def show_line(self, line: str) -> None:
        if not self._is_replaying:
            self._inner.show_line(line)

    def show_stage(self, stage: StageHead) -> None:
        self._inner.show_stage(stage)

    def show_check(self, check: CheckRecord) -> None:
        self._inner.show_check(check)

    def ask_question(self, question: Question) -> str:
        if self._is_replaying:
            key, answer = self._given[self._asked]
            if key == question.key:
                self._asked += 1
                return answer
            del self._given[self._asked :]  # another question: devices have changed meanwhile
        answer = self._inner.ask_question(question)
        if self._given and self._given[-1][0] == question.key:
            self._given.pop()  # a mistake, asked once more
            self._asked -= 1
        self._given.append([question.key, answer])
        self._asked += 1
        self._keep()
        return answer


def hold_interview(path: Path, display: SessionDisplay, ask: Callable[[Dialogue], T]) -> T:
    """Ask until the end, and return what the questions have given.

    Parameters
    ----------
    path : Path
        Of the answers; an existing file is continued. It is removed at the end.
    display : SessionDisplay
        Shows the questions and returns what is typed.
    ask : callable
        Asks; it is called again after each `back`.

    Raises
    ------
    InterviewStoppedError
        At Ctrl-C, `quit` or the end of the input.
    DeviceError
        The file cannot be written.
    """
    given = _read_answers(path)
    if given:
        display.show_line(f"{path}: continuing after {len(given)} answers; `back` repeats the last")

    def keep() -> None:
        text = json.dumps({"schema": _SCHEMA, "answers": given}, ensure_ascii=False)
        with errors.convert_write_errors(path, errors.DeviceError):
            files.write_text_atomic(path, text + "\n")

    remembered: dict[str, str] = {}
    while True:
        try:
            found = ask(Dialogue(_AnswerList(display, given, keep), remembered, lambda: None))
        except GoBackError:
            del given[-2:]  # `back` itself, and the answer before it
            keep()
            continue
        except (StopSessionError, KeyboardInterrupt, EOFError) as error:
            if isinstance(error, StopSessionError):
                given.pop()  # `quit` itself
                keep()
            raise InterviewStoppedError(
                f"stopped; nothing is lost: the same command continues ({path})"
            ) from None
        files.remove_file(path)
        return found


def _read_answers(path: Path) -> list[list[str]]:
    """The answers of a file; none without one, or if it is damaged."""
    try:
        content = json.loads(files.read_text(path))
        answers = content["answers"] if content["schema"] == _SCHEMA else []
        return [[str(key), str(answer)] for key, answer in answers]
    except (OSError, ValueError, KeyError, TypeError):
        return []
