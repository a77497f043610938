"""Errors that end a command with one line and an exit code (docs/reference/interfaces.md)."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path


class Exit(IntEnum):
    """Exit codes of every command."""

    DONE = 0
    BAD_INPUT = 2
    REJECTED = 3
    DEVICE_FAILED = 4
    SAFETY_TRIP = 5
    INTERRUPTED = 130


class CommandError(Exception):
    """Ends a command; the message is one line with the problem, its place and the remedy."""

    exit = Exit.BAD_INPUT

    @property
    def lines(self) -> tuple[str, ...]:
        """The printed text: one line, even if quoted text has line ends."""
        return (str(self),)


class InputError(CommandError):
    """Bad usage, configuration or input."""


class FindingsError(InputError):
    """Several problems with the input, one line each."""

    def __init__(self, lines: Sequence[str]) -> None:
        super().__init__("\n".join(lines))
        self._lines = tuple(lines)

    @property
    def lines(self) -> tuple[str, ...]:
        """The printed text: one line for each problem."""
        return self._lines


class RejectedError(CommandError):
    """A measurement that must not be used."""

    exit = Exit.REJECTED


class DeviceError(CommandError):
    """A device, port, folder or disk that cannot be used."""

    exit = Exit.DEVICE_FAILED


def os_reason(error: OSError) -> str:
    """The operating system's reason, for use within a sentence."""
    # what the socket module adds
    text = (error.strerror or str(error)).partition(" (while attempting")[0]
    return text[:1].lower() + text[1:]


@contextmanager
def convert_write_errors(
    target: Path, kind: type[CommandError] = InputError, remedy: str = ""
) -> Iterator[None]:
    """Turn an OSError of the block into a command's error with the reason and a remedy.

    Parameters
    ----------
    target : Path
        What the block writes.
    kind : type
        The error to raise.
    remedy : str
        Appended to the message.
    """
    try:
        yield
    except OSError as error:
        raise kind(f"{target}: cannot be written ({os_reason(error)}){remedy}") from None


@contextmanager
def name_source_in_errors(source: Path | None) -> Iterator[None]:
    """Put the file before an error of the block that begins with a key of it, such as
    `devices.pump: ...`.
    """
    try:
        yield
    except InputError as error:
        key = str(error).partition(":")[0]
        if source is None or key.startswith(str(source)) or "." not in key or set("/ ") & set(key):
            raise
        raise InputError(f"{source}: {error}") from None
