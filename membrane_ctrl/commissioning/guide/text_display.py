"""Shows a session as lines of text, and asks its questions by prompts: in the terminal."""

import sys
from collections.abc import Callable

from membrane_ctrl.commissioning.guide.dialogue import (
    Question,
    QuestionKind,
    SessionDisplay,
    StageHead,
)
from membrane_ctrl.commissioning.guide.session_state import CheckRecord

ReadLine = Callable[[str, str], str]  # key and prompt; raises EOFError at the end of input


class TextDisplay(SessionDisplay):
    """Lines and prompts.

    Parameters
    ----------
    read_line : callable
        Gets the key of a question and its prompt; returns the typed line.
    show_line : callable
        Shows a line.
    """

    def __init__(self, read_line: ReadLine, show_line: Callable[[str], None]) -> None:
        self._read_line = read_line
        self._show_line = show_line

    def show_line(self, line: str) -> None:
        """Show a line."""
        self._show_line(line)

    def show_stage(self, stage: StageHead) -> None:
        """Show the head of a stage."""
        self._show_line("")
        self._show_line(f"{stage.step}. {stage.title}: {stage.name}")
        self._show_line(f"  It {stage.does}.")
        self._show_line(f"  To be seen: {stage.look_for}.")

    def show_check(self, check: CheckRecord) -> None:
        """Show a check with its limit, and what to do if it failed."""
        limit = f" ({check.limit})" if check.limit else ""
        self._show_line(f"  {check.verdict}: {check.name}: {check.measured}{limit}")
        if check.remedy:
            self._show_line(f"    {check.remedy}")

    def ask_question(self, question: Question) -> str:
        """Show a question and return the typed line."""
        match question.kind:
            case QuestionKind.CONFIRMATION:
                prompt = f"{question.text} [y/n]"
            case QuestionKind.READINESS:
                prompt = f"{question.text}, then press Enter"
            case QuestionKind.CHOICE:
                self._show_choices(question)
                prompt = "number or name"
            case QuestionKind.NUMBER if question.unit:
                prompt = f"{question.text} [{question.unit}]"
            case _:
                prompt = question.text
        if question.default:
            prompt += f" ({question.default})"
        return self._read_line(question.key, prompt)

    def _show_choices(self, question: Question) -> None:
        self._show_line(question.text)
        width = max(len(choice.name) for choice in question.choices)
        for number, choice in enumerate(question.choices, 1):
            self._show_line(f"  {number}  {choice.name:{width}}  {choice.meaning}".rstrip())


def read_terminal_line(key: str, prompt: str) -> str:
    """Read a line from the terminal. Raises EOFError at its end.

    Parameters
    ----------
    key : str
        Key of the question; not used here: tests answer by it.
    prompt : str
        Printed in front of the answer, without the colon.
    """
    print(f"{prompt}: ", end="", flush=True)
    line = sys.stdin.readline()
    if not line:
        raise EOFError
    return line.rstrip("\n")


def print_line(line: str) -> None:
    """Print a line at once."""
    print(line, flush=True)
