"""The client of the port: plain blocking sockets, for the command line and for programs."""

from __future__ import annotations

import errno
import json
import socket
import ssl
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from membrane_ctrl.control_port import protocol, sockets
from membrane_ctrl.model.errors import DeviceError, os_reason

Message = dict[str, Any]
_ANSWER_S = 10.0
_TURN = struct.pack("ll", 10, 0)  # time-out while queueing to connect: s and us, as the kernel takes it


class PortClient:
    """A connection to a running hold; `notice` gets unsolicited notices. Raises DeviceError if no hold answers."""

    def __init__(self, connection: socket.socket, where: str, notice: Callable[[str], None]) -> None:
        self._connection, self._where, self._notice = connection, where, notice
        self._lines = connection.makefile("rb")
        self._number = 0
        try:
            greeting = self._next()
            self._greeted_s = time.monotonic()
        except DeviceError:
            self.close()
            raise
        if greeting is None:  # the hold records the reason; with TLS it is usually a refused certificate
            self.close()
            raise DeviceError(f"{where}: no greeting; with TLS, check the certificate")
        if "membrane_ctrl" not in greeting:
            self.close()
            raise DeviceError(f"{where}: not a control port of membrane-ctrl")
        self.greeting = greeting  # `run`, `you`, `role`, `commander`

    @classmethod
    def unix(cls, path: str | Path, notice: Callable[[str], None]) -> PortClient:
        """Connect to a socket file."""
        path = Path(path)
        connection = socket.socket(socket.AF_UNIX)
        # While others crowd the endpoint, only a blocking connect waits its turn; with Python's own time-out it would
        # be refused at once.
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _TURN)
        try:
            with sockets.short(path) as address:
                connection.connect(address)
            connection.getpeername()  # after a signal during the wait, Python wrongly assumes a connection
            connection.settimeout(_ANSWER_S)
        except (FileNotFoundError, ConnectionRefusedError):
            connection.close()
            raise DeviceError(f"{path}: no hold is listening") from None
        except BlockingIOError:
            connection.close()
            raise DeviceError(f"{path}: too many connections are waiting; try again") from None
        except OSError as error:
            connection.close()
            if error.errno == errno.ENOTCONN:
                return cls.unix(path, notice)
            raise DeviceError(f"{path}: {os_reason(error)}") from None
        return cls(connection, str(path), notice)

    @classmethod
    def tls(cls, host: str, port: int, context: ssl.SSLContext, notice: Callable[[str], None]) -> PortClient:
        """Connect over TCP; the context holds our certificate (`sockets.client_context`)."""
        where = f"{host}:{port}"
        try:
            plain = socket.create_connection((host, port), _ANSWER_S)
        except OSError as error:
            raise DeviceError(f"{where}: {os_reason(error)}") from None
        try:
            secured = context.wrap_socket(plain, server_hostname=host)
        except OSError as error:
            plain.close()
            raise DeviceError(f"{where}: {_tls_reason(error)}") from None
        return cls(secured, where, notice)

    def ask(self, **request: Any) -> Message:
        """Send a request (`protocol.Request`) and wait for its answer. Raises DeviceError if none comes."""
        self._number += 1
        try:
            self._connection.sendall(protocol.encode({**self._expiry(), **request, "number": self._number}))
        except OSError as error:
            raise DeviceError(f"{self._where}: {os_reason(error)}") from None
        for message in self.messages():
            if message.get("number") in (self._number, 0):  # 0: the hold could not read the request's number
                return message
        raise DeviceError(f"{self._where}: the hold closed the connection without an answer")

    def _expiry(self) -> Message:
        """The time after which nobody waits for the answer, on the hold's clock; none if the hold sends no clock.

        A hold that hangs for longer must not obey the request afterwards.
        """
        now_s = self.greeting.get("now_s")
        if not isinstance(now_s, int | float):
            return {}
        return {"expires_s": now_s + time.monotonic() - self._greeted_s + _ANSWER_S}

    def messages(self) -> Iterator[Message]:
        """Yield messages until the hold ends; pass on notices."""
        while (message := self._next()) is not None:
            if "notice" in message:
                self._notice(str(message["notice"]))
            else:
                yield message

    def patience(self, seconds: float) -> None:
        """Set how long the next message may take."""
        self._connection.settimeout(seconds)

    def close(self) -> None:
        """Hang up."""
        self._lines.close()
        self._connection.close()

    def __enter__(self) -> PortClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _next(self) -> Message | None:
        try:
            line = self._lines.readline()
        except ConnectionResetError:
            return None
        except TimeoutError:
            raise DeviceError(f"{self._where}: the hold does not answer; is it stopped or overloaded?") from None
        except OSError as error:  # TLS: a refused certificate shows only when reading
            self.close()
            refused = isinstance(error, ssl.SSLError)
            reason = f"{_tls_reason(error)}; check the certificate" if refused else os_reason(error)
            raise DeviceError(f"{self._where}: {reason}") from None
        if not line.endswith(b"\n"):
            return None
        try:
            message = json.loads(line)
        except ValueError:
            message = None
        if not isinstance(message, dict):
            raise DeviceError(f"{self._where}: the answer is not a JSON object")
        return message


def _tls_reason(error: OSError) -> str:
    """Why there is no secure connection, in words."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"the hold's certificate is not trusted: {error.verify_message}"
    if isinstance(error, TimeoutError):
        return "no TLS answer; is it a hold's TLS port?"
    if isinstance(error, ssl.SSLError):
        return f"no TLS connection ({str(error.reason or 'broken off').lower().replace('_', ' ')})"
    return os_reason(error)
