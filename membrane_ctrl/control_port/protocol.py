"""One JSON object per line in either direction, and limits so that no message costs a tick.

A request carries a number; its answer carries the same. Messages without a number are unsolicited: the greeting,
notices, and the stream of `watch`. `PortSession` is one client from greeting to goodbye.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import socket
import ssl
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError, model_validator

from firmware_iface.settings import Section
from membrane_ctrl.config import toml_file
from membrane_ctrl.control_port.answers import COMMAND_TAKEN
from membrane_ctrl.controller.commands import TABLE, Kind, Role
from membrane_ctrl.model.events import Event

VERSION = 1

# The longest honest message is `gains` with every key of the loop: 900 bytes. 8 kB are parsed in 0.1 ms.
MESSAGE_BYTES = 8192

# who, why and text go into one event, and JSON makes up to 3 bytes of one in UTF-8: together they fit its slot
WHO_BYTES, WHY_BYTES, TEXT_BYTES = 64, 300, 500

Errand = Literal["status", "watch", "release", "quiet", "claim"]
Action = Literal[Kind, Errand]


class RequestError(ValueError):
    """A message that is not a valid request; the text is the answer."""

    def __init__(self, reason: str, number: int = 0) -> None:
        super().__init__(reason)
        self.number = number


def _words(most_bytes: int) -> AfterValidator:
    def check(text: str) -> str:
        if not text.isprintable():
            raise ValueError("only printable characters, in one line")
        if len(text.encode()) > most_bytes:
            raise ValueError(f"longer than {most_bytes} bytes")
        return text

    return AfterValidator(check)


_ERRAND_NEEDS: dict[str, tuple[str, ...]] = {"claim": ("text",)}


class Request(Section):
    """A client's request."""

    number: Annotated[int, Field(ge=0, lt=2**53)] = 0  # chosen by the client, returned with the answer
    # a command of `commands.TABLE`, or `status` (once), `watch` (repeated status), `claim` (command for a session,
    # this connection), `release` (give up command), `quiet` (acknowledge the alarms)
    do: Action
    why: Annotated[str, _words(WHY_BYTES)] = ""  # recorded with the command
    value: float | None = None  # `setpoint`: um. `manual`: um/s. `gains`: trial time, s
    # `mark`: the remark. `latch`: why the mirror is locked. `claim`: the session's name
    text: Annotated[str, _words(TEXT_BYTES)] = ""
    loop: dict[str, bool | float] | None = None  # `gains`: the keys of `[loop]` that change
    pump: dict[str, Any] | None = None  # `gains`: the table `[pump]`, if it changes
    experiment: dict[str, Any] | None = None  # `tune`: an `ExperimentSpec`, which says what it takes
    shape_time_constant_s: float | None = None  # `gains`: of the shape loop
    setpoint_step_um: Annotated[float, Field(ge=-30, le=30)] | None = None  # `gains`: of the setpoint, on trial
    take_over: bool = False  # take command from whoever has it
    period_s: Annotated[float, Field(ge=0.1, le=3600)] = 1.0  # `watch`: interval

    @model_validator(mode="after")
    def _complete(self) -> Request:
        rule = TABLE.get(self.do)  # type: ignore[arg-type]
        needs, takes = (rule.needs, rule.takes) if rule else (_ERRAND_NEEDS.get(self.do, ()), ())
        for name in ("value", "text", "loop", "pump", "experiment", "shape_time_constant_s", "setpoint_step_um"):
            given = getattr(self, name) not in (None, "")
            if given and name not in (*needs, *takes):
                raise ValueError(f"{self.do} takes no {name}")
            if not given and name in needs:
                raise ValueError(f"{self.do}: {name} missing")
        return self


def parse(line: bytes) -> Request:
    """Parse a request. Raises RequestError with one line that says what is wrong."""
    try:
        return Request.model_validate_json(line, strict=True)
    except ValidationError as error:
        reason = toml_file.describe(error.errors(include_url=False)[0], Request).removeprefix(": ")
        raise RequestError(_short(reason), _number_in(line)) from None


def encode(message: dict[str, Any]) -> bytes:
    """Encode a message as a line."""
    return json.dumps(message, allow_nan=False, default=str).encode() + b"\n"


def _number_in(line: bytes) -> int:
    """Number of an otherwise invalid request, so that its sender can match the answer."""
    try:
        number = json.loads(line)["number"]
    except (ValueError, TypeError, LookupError, RecursionError):
        return 0
    return number if type(number) is int and 0 <= number < 2**53 else 0


def _short(reason: str, most: int = 300) -> str:
    """One printable line, which may quote the client."""
    clean = "".join(c if c.isprintable() else "?" for c in reason)
    return clean if len(clean) <= most else clean[: most - 3] + "..."


_LINE_S = 5.0  # to complete a line
# A reader this far behind is dropped: a 10 Hz watcher after a minute
_UNREAD_BYTES = 1 << 20
_HANDSHAKE_S = 3.0


class SlowReaderError(ConnectionError):
    """The peer has not read for too long."""


class Wire:
    """Reads and writes lines."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    @classmethod
    async def on(cls, connection: socket.socket, context: ssl.SSLContext | None = None) -> Wire:
        """Take over an accepted connection. Raises OSError (ssl.SSLError among them) if the handshake fails."""
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader(limit=MESSAGE_BYTES, loop=loop)
        protocol = asyncio.StreamReaderProtocol(reader, loop=loop)
        secured = {"ssl": context, "ssl_handshake_timeout": _HANDSHAKE_S} if context else {}
        transport, _ = await loop.connect_accepted_socket(lambda: protocol, connection, **secured)  # type: ignore[arg-type]
        return cls(reader, asyncio.StreamWriter(transport, protocol, reader, loop))

    @property
    def certificate(self) -> dict[str, Any]:
        """The peer's certificate, as from `ssl.SSLSocket.getpeercert`."""
        found: dict[str, Any] | None = self._writer.get_extra_info("peercert")
        return found or {}

    async def line(self) -> bytes | None:
        """The next line; None when the peer has gone. Raises RequestError if it is too long or too slow."""
        try:
            first = await self._reader.read(1)  # a peer may be silent for hours between lines
            if first in (b"", b"\n"):
                return first or None
            # not `wait_for`, which loses a cancellation that coincides with its result
            async with asyncio.timeout(_LINE_S):
                rest = await self._reader.readuntil(b"\n")
        except asyncio.LimitOverrunError:
            raise RequestError(f"a message may have at most {MESSAGE_BYTES} bytes") from None
        except TimeoutError:
            raise RequestError(f"a message must be complete within {_LINE_S:g} s") from None
        except (asyncio.IncompleteReadError, OSError):
            return None
        return first + rest

    def send(self, message: dict[str, Any]) -> None:
        """Send without waiting. Raises SlowReaderError (and ends the connection) if too much is unread."""
        transport = self._writer.transport
        if transport.is_closing():
            return
        if transport.get_write_buffer_size() > _UNREAD_BYTES:
            transport.abort()
            raise SlowReaderError("does not read its messages")
        self._writer.write(encode(message))

    async def until(self, end: bytes) -> bytes:
        """Read up to `end`. Raises asyncio's LimitOverrunError or IncompleteReadError."""
        return await self._reader.readuntil(end)

    def send_bytes(self, data: bytes) -> None:
        """Send an answer that is not a line."""
        self._writer.write(data)

    async def close(self) -> None:
        """Send remaining data if possible without waiting, and end."""
        self._writer.close()
        try:
            async with asyncio.timeout(1.0):
                await self._writer.wait_closed()
        except (TimeoutError, OSError):
            self._writer.transport.abort()

    def abort(self) -> None:
        """End the connection now."""
        self._writer.transport.abort()


_RANK: dict[Role, int] = {"read": 0, "operate": 1, "tune": 2}
_ERRANDS: dict[str, Role] = {
    "status": "read", "watch": "read", "claim": "operate", "release": "operate", "quiet": "operate",
}  # fmt: skip

# These need no command: stopping the pump is always accepted, and the others move nothing
FREE = frozenset({"status", "watch", "stop", "latch", "mark", "release", "quiet"})


@dataclass(frozen=True, slots=True)
class Peer:
    """The peer of a connection: `unix:NAME` or `tls:NAME`, as given by the system or a certificate."""

    who: str
    role: Role
    pid: int | None = field(default=None, compare=False)  # of its process, if it is on this machine


def may_not(peer: Peer, do: Action) -> str:
    """Why the peer's role forbids this request; empty if it does not."""
    needed = TABLE[do].role if do in TABLE else _ERRANDS[do]
    if _RANK[peer.role] >= _RANK[needed]:
        return ""
    return f"{do} needs the role {needed}; {peer.who} has {peer.role}"


# A client that sends faster is read more slowly: all requests together cost less than a tick in fifty
_PAUSE_S = 0.1
# A program that sends this many invalid requests in a row will not stop
_NONSENSE_MOST = 10

Answer = Callable[["PortSession", Request], Awaitable[dict[str, Any]]]
Refused = Callable[[str, str, str], None]


class PortSession:
    """A connection whose peer is known; `watch` streams `status`."""

    def __init__(self, wire: Wire, peer: Peer, status: Callable[[], dict[str, Any]]) -> None:
        self.peer = peer
        self.id = secrets.token_hex(4)  # of the connection
        self.heard_s = asyncio.get_running_loop().time()  # time of the peer's last request
        self._wire = wire
        self._status = status
        self._watch: asyncio.Task[None] | None = None

    async def run(self, greeting: dict[str, Any], answer: Answer, refused: Refused) -> None:
        """Answer requests until the peer disconnects."""
        try:
            self._wire.send(greeting)
            await self._converse(answer, refused)
        except SlowReaderError as error:
            refused(self.peer.who, "", str(error))
        except RequestError as error:
            refused(self.peer.who, "", str(error))
            with contextlib.suppress(SlowReaderError):
                self._wire.send({"number": 0, "ok": False, "refused": str(error)})
        finally:
            self.watch(None)
            await self._wire.close()

    async def _converse(self, answer: Answer, refused: Refused) -> None:
        nonsense = 0
        while (line := await self._wire.line()) is not None:
            self.heard_s = asyncio.get_running_loop().time()
            try:
                request = parse(line)
            except RequestError as error:
                nonsense += 1
                if nonsense > _NONSENSE_MOST:
                    raise
                refused(self.peer.who, "", str(error))
                self._wire.send({"number": error.number, "ok": False, "refused": str(error)})
            else:
                nonsense = 0
                self._wire.send({"number": request.number, **await answer(self, request)})
            await asyncio.sleep(_PAUSE_S)

    def notice(self, text: str) -> None:
        """Send an unsolicited notice."""
        with contextlib.suppress(SlowReaderError):
            self._wire.send({"notice": text})

    def command_taken(self, text: str) -> None:
        """Send the notice that this connection has lost command to another."""
        with contextlib.suppress(SlowReaderError):
            self._wire.send({"notice": text, "code": COMMAND_TAKEN})

    def event(self, event: Event) -> None:
        """Send an event to a watching peer."""
        if self._watch is not None:
            with contextlib.suppress(SlowReaderError):
                self._wire.send({"event": event.to_dict()})

    def watch(self, period_s: float | None) -> None:
        """Stream the status from now on; None ends it."""
        if self._watch is not None:
            self._watch.cancel()
        self._watch = None if period_s is None else asyncio.create_task(self._stream(period_s), name="port watch")

    async def _stream(self, period_s: float) -> None:
        with contextlib.suppress(SlowReaderError):
            while True:
                await asyncio.sleep(period_s)
                self._wire.send({"status": self._status()})

    def drop(self, why: str) -> None:
        """End the connection with a last message."""
        self.notice(why)
        self._wire.abort()
