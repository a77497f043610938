"""The client of the port: plain blocking sockets, for the command line and for programs.

Every program that talks to a hold uses this client. What it returns is checked (`answers`), and
reading is bounded in length, number and time (`lines`): a peer that is not a hold ends in one
`DeviceError`.
"""

from __future__ import annotations

import contextlib
import errno
import math
import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from membrane_ctrl.control_port import answers, lines, message_syntax, protocol, sockets
from membrane_ctrl.control_port.message_syntax import Message
from membrane_ctrl.model.errors import DeviceError, os_reason

ANSWER_S = 10.0  # for a connection with its greeting, and for an answer
_WITH_STATUS = frozenset({"status", "watch"})


class PortClient:
    """A connection to a running hold. Raises DeviceError if no hold answers.

    Parameters
    ----------
    connection : socket
        Connected; the client closes it.
    where : str
        The address, for messages.
    notice : callable
        Gets unsolicited notices.
    until_s : float, optional
        Monotonic time by which the hold must have greeted.

    Attributes
    ----------
    greeting : dict
        `run`, `you`, `role`, `commander`.
    command_taken : str
        Who has taken over command from this client, and why; empty if nobody has.
    """

    def __init__(
        self,
        connection: socket.socket,
        where: str,
        notice: Callable[[str], None],
        until_s: float | None = None,
    ) -> None:
        self._connection = connection
        self._where = where
        self._notice = notice
        self._lines = lines.LineReader(connection)
        self._number = 0
        self.command_taken = ""
        self._patience_s = ANSWER_S
        if until_s is None:
            until_s = time.monotonic() + ANSWER_S
        try:
            self.greeting = self._read_greeting(until_s)
            self._greeted_s = time.monotonic()
        except DeviceError:
            self.close()
            raise

    @classmethod
    def unix(
        cls, path: str | Path, notice: Callable[[str], None], answer_s: float = ANSWER_S
    ) -> PortClient:
        """Connect to a socket file.

        Parameters
        ----------
        path : str or Path
            The file.
        notice : callable
            Receives the unsolicited notices of the hold, such as a loss of command.
        answer_s : float
            Longest time for connection and greeting.
        """
        path = Path(path)
        until_s = time.monotonic() + answer_s
        connection = socket.socket(socket.AF_UNIX)
        try:
            # While others crowd the endpoint, only a blocking connect waits its turn; with Python's
            # own time-out it would be refused at once.
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _kernel_time(answer_s))
            with sockets.short(path) as address:
                connection.connect(address)
            # after a signal during the wait, Python wrongly assumes a connection
            connection.getpeername()
        except (FileNotFoundError, ConnectionRefusedError):
            connection.close()
            raise DeviceError(f"{path}: no hold is listening") from None
        except BlockingIOError:
            connection.close()
            raise DeviceError(f"{path}: too many connections are waiting; try again") from None
        except OSError as error:
            connection.close()
            left_s = until_s - time.monotonic()
            if error.errno == errno.ENOTCONN and left_s > 0.0:
                return cls.unix(path, notice, left_s)
            raise DeviceError(f"{path}: {os_reason(error)}") from None
        return cls(connection, str(path), notice, until_s)

    def ask(self, **request: Any) -> Message:
        """Send a request (`protocol.Request`) and return its answer. Raises DeviceError if none
        comes in time.
        """
        # Answers carry the number of their request: one that came too late for an earlier request
        # is passed over
        self._number += 1
        until_s = time.monotonic() + self._patience_s
        try:
            self._connection.settimeout(self._patience_s)
            self._connection.sendall(
                protocol.encode({**self._expiry(), **request, "number": self._number})
            )
        except OSError as error:
            raise DeviceError(f"{self._where}: {os_reason(error)}") from None
        while (message := self._next(until_s)) is not None:
            # 0: the hold could not read the request's number
            if answers.kind_of(message) == "answer" and message["number"] in (self._number, 0):
                return self._checked_answer(message, request)
        raise DeviceError(f"{self._where}: the hold closed the connection without an answer")

    def _expiry(self) -> Message:
        """The time after which nobody waits for the answer, on the hold's clock; none if the hold
        sends no clock.

        A hold that hangs for longer must not obey the request afterwards.
        """
        now_s = self.greeting.get("now_s")
        if not isinstance(now_s, int | float):
            return {}
        return {"expires_s": now_s + time.monotonic() - self._greeted_s + self._patience_s}

    def messages(self) -> Iterator[Message]:
        """Yield what `watch` streams until the hold ends; pass on notices."""
        while (message := self._next(time.monotonic() + self._patience_s)) is not None:
            if answers.kind_of(message) == "streamed":
                yield message

    def status(self) -> Message:
        """Ask for the status: the whole answer. Raises DeviceError without one, also if it is
        refused.
        """
        answer = self.ask(do="status")
        if not answer["ok"]:
            raise DeviceError(f"{self._where}: status refused: {answer['refused']}")
        return answer

    def poll(self) -> None:
        """Take the notices that have arrived, without waiting. Raises DeviceError if the hold has
        hung up.
        """
        while self._lines.waiting():
            if self._any_message(time.monotonic() + self._patience_s) is None:
                raise DeviceError(
                    f"{self._where}: the hold has closed the connection; has it ended?"
                )

    def patience(self, seconds: float) -> None:
        """Set how long the next message may take."""
        self._patience_s = seconds

    def close(self) -> None:
        """Hang up; a thread that waits for a message returns."""
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()

    def __enter__(self) -> PortClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read_greeting(self, until_s: float) -> Message:
        line = self._read_line(until_s)
        if line is None:  # the hold records the reason
            raise DeviceError(f"{self._where}: no greeting; see the events of the hold")
        try:
            return answers.check_greeting(message_syntax.decode(line))
        except message_syntax.AnswerError as error:
            raise self._not_of_a_hold(error) from None

    def _next(self, until_s: float) -> Message | None:
        """The next checked message that is not a notice; None if the hold has hung up."""
        while (message := self._any_message(until_s)) is not None:
            if answers.kind_of(message) != "notice":
                return message
        return None

    def _any_message(self, until_s: float) -> Message | None:
        """The next checked message, after it was passed on if it is a notice; None if the hold has
        hung up.
        """
        line = self._read_line(until_s)
        if line is None:
            return None
        try:
            message = answers.check_message(message_syntax.decode(line))
        except message_syntax.AnswerError as error:
            raise self._not_of_a_hold(error) from None
        if answers.kind_of(message) == "notice":
            if message.get("code") == answers.COMMAND_TAKEN:
                self.command_taken = message["notice"]
            self._notice(message["notice"])
        return message

    def _checked_answer(self, answer: Message, request: Message) -> Message:
        """Check what an answer must bring: the status that was asked for, or a reason."""
        if not answer["ok"] and answer.get("refused") is None:
            raise self._not_of_a_hold(message_syntax.AnswerError("refused: missing"))
        if answer["ok"] and request.get("do") in _WITH_STATUS and answer.get("status") is None:
            raise self._not_of_a_hold(message_syntax.AnswerError("status: missing"))
        return answer

    def _not_of_a_hold(self, error: message_syntax.AnswerError) -> DeviceError:
        return DeviceError(f"{self._where}: not an answer of a hold ({error})")

    def _read_line(self, until_s: float) -> bytes | None:
        try:
            return self._lines.read_line(until_s)
        except lines.LineError as error:
            raise DeviceError(f"{self._where}: sends {error}, as no hold does") from None
        except ConnectionResetError:
            return None
        except TimeoutError:
            raise DeviceError(
                f"{self._where}: the hold does not answer; is it stopped or overloaded?"
            ) from None
        except OSError as error:
            raise DeviceError(f"{self._where}: {os_reason(error)}") from None


def _kernel_time(seconds: float) -> bytes:
    """A time as `SO_SNDTIMEO` takes it: seconds and microseconds; zero would mean no limit."""
    fraction, whole = math.modf(max(seconds, 0.001))
    return struct.pack("ll", int(whole), int(1e6 * fraction))
