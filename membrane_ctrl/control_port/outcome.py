"""What became of a command that a page, a bridge or a console sent."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a command.

    Attributes
    ----------
    command : str
        Its name, as people read it.
    text : str
        One line for people, which begins with the name.
    done : bool
        Whether the hold obeyed it completely.
    """

    command: str
    text: str
    done: bool = False

    @classmethod
    def failed(cls, command: str, reason: str) -> "Outcome":
        """The outcome of a command that did not reach the hold, or got no answer.

        Parameters
        ----------
        command : str
            Its name, as people read it.
        reason : str
            Why, within a sentence. The hold may still have obeyed.
        """
        return cls(command, f"{command}: {reason}")

    @classmethod
    def refused(cls, command: str, reason: str) -> "Outcome":
        """The outcome of a command that was refused: it has changed nothing.

        Parameters
        ----------
        command : str
            Its name, as people read it.
        reason : str
            Why, within a sentence.
        """
        return cls(command, f"{command} refused: {reason}")

    @classmethod
    def succeeded(cls, command: str) -> "Outcome":
        """The outcome of a command that was obeyed."""
        return cls(command, f"{command}: done", done=True)

    @classmethod
    def from_answer(cls, command: str, answer: Mapping[str, Any]) -> "Outcome":
        """The outcome by the hold's answer.

        Parameters
        ----------
        command : str
            Its name, as people read it.
        answer : mapping
            `ok`; `refused` with the reason if not; `problem` if a lock counts, but is not on the
            disk.
        """
        if not answer.get("ok"):
            return cls.refused(command, str(answer.get("refused")))
        if answer.get("problem"):
            return cls.failed(command, f"not stored, valid in this run only: {answer['problem']}")
        return cls.succeeded(command)
