"""Questions to the person at the bench. `back` and `stop` are accepted at every prompt."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")
ReadLine = Callable[[str, str], str]  # key and prompt; raises EOFError at the end of input
_BACK, _STOP = ("back", "b"), ("stop", "quit")


class GoBackError(Exception):
    """The person wants to return to the previous stage."""


class StopSessionError(Exception):
    """The person wants to stop, and to resume later."""


@dataclass(frozen=True, slots=True)
class Choice:
    """An entry of a numbered list."""

    name: str
    meaning: str = ""


class Dialogue:
    """Asks and shows.

    Parameters
    ----------
    read_line : callable
        Gets the key of a question and its prompt; returns the typed line.
    show_line : callable
        Shows a line.
    remembered : dict
        Typed answers by key: each becomes the default when its question is asked again.
    remember : callable
        Called after each answer, to store them.
    """

    def __init__(
        self,
        read_line: ReadLine,
        show_line: Callable[[str], None],
        remembered: dict[str, str],
        remember: Callable[[], None],
    ) -> None:
        self._read_line = read_line
        self._show_line = show_line
        self._remembered = remembered
        self._remember = remember

    def show(self, *lines: str) -> None:
        """Show lines."""
        for line in lines:
            self._show_line(line)

    def ask_text(self, key: str, question: str, default: str = "") -> str:
        """Ask for a text; an empty answer is the default."""
        return self._ask(key, question, default, lambda text: text)

    def ask_number(
        self, key: str, question: str, default: float, low: float, high: float, unit: str = ""
    ) -> float:
        """Ask for a number within limits."""

        def parse(text: str) -> float:
            try:
                value = float(text.replace(",", "."))
            except ValueError:
                raise ValueError("write a number, such as 37.1") from None
            if not low <= value <= high or not math.isfinite(value):
                raise ValueError(f"must be within {low:g} .. {high:g} {unit}".rstrip())
            return value

        return self._ask(key, f"{question} [{unit}]" if unit else question, f"{default:g}", parse)

    def ask_choice(
        self, key: str, question: str, choices: Sequence[Choice], default: str = ""
    ) -> str:
        """Ask for one of a numbered list; returns its name. A number or a name is accepted."""
        names = [choice.name for choice in choices]
        self.show(question)
        width = max(len(name) for name in names)
        for number, choice in enumerate(choices, 1):
            self.show(f"  {number}  {choice.name:{width}}  {choice.meaning}".rstrip())

        def parse(text: str) -> str:
            if text in names:
                return text
            if text.isdecimal() and 1 <= int(text) <= len(names):
                return names[int(text) - 1]
            raise ValueError(f"choose a number from 1 to {len(names)}, or a name")

        return self._ask(key, "number or name", default, parse)

    def confirm(self, key: str, question: str) -> bool:
        """Ask yes or no; there is no default, because it must be seen each time."""

        def parse(text: str) -> bool:
            if text.lower() in ("y", "yes"):
                return True
            if text.lower() in ("n", "no"):
                return False
            raise ValueError("answer y or n")

        while True:
            typed = self._read(key, f"{question} [y/n]")
            try:
                return parse(typed)
            except ValueError as error:
                self.show(f"  {error}")

    def wait(self, key: str, request: str) -> None:
        """Ask the person to do something and to press Enter."""
        self._read(key, f"{request}, then press Enter")

    def _ask(self, key: str, question: str, default: str, parse: Callable[[str], T]) -> T:
        default = self._remembered.get(key, default)
        while True:
            typed = self._read(key, f"{question} ({default})" if default else question)
            try:
                value = parse(typed or default)
            except ValueError as error:
                self.show(f"  {error}")
                continue
            self._remembered[key] = typed or default
            self._remember()
            return value

    def _read(self, key: str, prompt: str) -> str:
        typed = self._read_line(key, prompt).strip()
        if typed.lower() in _BACK:
            raise GoBackError
        if typed.lower() in _STOP:
            raise StopSessionError
        return typed
