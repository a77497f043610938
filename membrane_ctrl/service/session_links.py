"""How the service reaches a guided session: a program that it starts, or a unit of systemd.

Under systemd the service has no devices: it answers a network. A session at the bench runs as a
unit of its own then, which has them. The service connects to the unit's socket, and systemd starts
`membrane-ctrl commission` with the connection as its input and output.
"""

from __future__ import annotations

import signal
import socket
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

from membrane_ctrl.commissioning.guide.session_messages import BeginMessage
from membrane_ctrl.model import errors

SESSION_SOCKET = Path("/run/membrane-commission.sock")  # of membrane-commission.socket
_NO_UNIT = (
    "run `sudo membrane-ctrl service install` once; or use a terminal (docs/how-to/service.md)"
)


class SessionLink(ABC):
    """The connection to a running session.

    Attributes
    ----------
    source : file
        Of its messages; it ends with the session.
    """

    source: IO[str]

    @abstractmethod
    def send_line(self, line: str) -> None:
        """Send a line; one to a session that has ended is dropped."""

    @abstractmethod
    def interrupt(self) -> None:
        """Stop the session as Ctrl-C does."""

    @abstractmethod
    def close(self) -> int | None:
        """Close the connection after its end; the program's exit code, if this process has it."""


class ProgramLink(SessionLink):
    """A session that is a child of this process.

    Parameters
    ----------
    words : sequence of str
        The program.
    log : file
        For what it prints beside its messages.
    """

    def __init__(self, words: Sequence[str], log: IO[str]) -> None:
        self._process = subprocess.Popen(
            words,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            encoding="utf-8",
            errors="replace",
            start_new_session=True,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._target = self._process.stdin
        self.source = self._process.stdout

    def send_line(self, line: str) -> None:
        """Send a line; one to a session that has ended is dropped."""
        with suppress(BrokenPipeError):
            print(line, file=self._target, flush=True)

    def interrupt(self) -> None:
        """Stop the session as Ctrl-C does."""
        self._process.send_signal(signal.SIGINT)

    def close(self) -> int | None:
        """Close the pipes; the program's exit code."""
        code = self._process.wait()
        self.source.close()
        with suppress(BrokenPipeError):
            self._target.close()
        return code


class UnitLink(SessionLink):
    """A session that systemd starts for this connection.

    Parameters
    ----------
    path : Path
        Of the unit's socket.
    name : str
        Of the session.

    Raises
    ------
    DeviceError
        Nothing listens there.
    """

    def __init__(self, path: Path, name: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            reason = errors.os_reason(error)
            raise errors.DeviceError(f"{path}: {reason}: {_NO_UNIT}") from None
        self.source = self._socket.makefile("r", encoding="utf-8", errors="replace")
        self.send_line(BeginMessage(session=name).model_dump_json())

    def send_line(self, line: str) -> None:
        """Send a line; one to a session that has ended is dropped."""
        with suppress(OSError):
            self._socket.sendall(f"{line}\n".encode())

    def interrupt(self) -> None:
        """End its input: it stops at once then, and still sends its last messages."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)

    def close(self) -> int | None:
        """Close the connection; the last message has the exit code."""
        self.source.close()
        self._socket.close()
        return None
