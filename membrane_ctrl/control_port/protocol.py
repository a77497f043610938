"""One JSON object per line in either direction, and limits so that no message costs a tick.

A request carries a number; its answer carries the same. Messages without a number are unsolicited:
the greeting, notices, and the stream of `watch`. `session.PortSession` is one client from greeting
to goodbye.
"""

from __future__ import annotations

import asyncio
import json
import socket
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError, field_validator, model_validator

from firmware_iface.settings import Section
from membrane_ctrl.config import toml_file
from membrane_ctrl.control_port.safety_commands import SAFETY
from membrane_ctrl.controller.commands import SAME_AS, TABLE, Kind, Role

VERSION = 1

# The longest honest message is `gains` with every key of the loop: 900 bytes. 8 kB are parsed in
# 0.1 ms.
MESSAGE_BYTES = 8192

# who, why and text go into one event, and JSON makes up to 3 bytes of one in UTF-8: together they
# fit its slot
WHO_BYTES, WHY_BYTES, TEXT_BYTES = 64, 300, 500

Errand = Literal["status", "watch", "release", "quiet", "claim"]
RequestName = Literal[Kind, Errand]


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


class OnBehalf(Section):
    """For whom a program sends a request: the service for the viewers of its page and for programs
    with a token, a bridge for other systems.

    The hold accepts the account only from a process of its own user on the socket file. From
    anybody the role only lowers the sender's own.
    """

    via: Literal["page", "token", "bridge"]
    # name with which the person logged in; empty: without a login
    account: Annotated[str, _words(WHO_BYTES - 8)] = ""
    name: Annotated[str, _words(WHO_BYTES - 8)] = ""  # who it is, for people, if there is no login
    session: Annotated[str, _words(WHO_BYTES)] = ""  # of that person
    # for whom a program asks, as it states itself
    viewer: Annotated[str, _words(WHO_BYTES - 8)] = ""
    role: Role


_ERRAND_NEEDS: dict[str, tuple[str, ...]] = {"claim": ("text",)}


class Request(Section):
    """A client's request."""

    # chosen by the client, returned with the answer
    number: Annotated[int, Field(ge=0, lt=2**53)] = 0
    # a command of `commands.TABLE`, or `status` (once), `watch` (repeated status), `claim` (command
    # for a session, this connection), `release` (give up command), `quiet` (acknowledge the alarms)
    do: RequestName
    why: Annotated[str, _words(WHY_BYTES)] = ""  # recorded with the command
    value: float | None = None  # `setpoint`: µm. `manual`: µm/s. `gains`: trial time, s
    # `mark`: the remark. `latch`: why the mirror is locked. `unlock`: the lock's word, which a
    # person typed. `claim`: the session's name
    text: Annotated[str, _words(TEXT_BYTES)] = ""
    loop: dict[str, bool | float] | None = None  # `gains`: the keys of `[loop]` that change
    pump: dict[str, Any] | None = None  # `gains`: the table `[pump]`, if it changes
    # `tune`: an `ExperimentSpec`, which says what it takes
    experiment: dict[str, Any] | None = None
    shape_time_constant_s: float | None = None  # `gains`: of the shape loop
    # `gains`: of the setpoint, on trial
    setpoint_step_um: Annotated[float, Field(ge=-30, le=30)] | None = None
    take_over: bool = False  # take command from the session that has it
    period_s: Annotated[float, Field(ge=0.1, le=3600)] = 1.0  # `watch`: interval
    on_behalf: OnBehalf | None = None  # None: the peer of the connection itself
    # time limit on the clock of the greeting's `now_s`; later the request is refused, unless it is
    # a safety command
    expires_s: float | None = None

    @field_validator("do", mode="before")
    @classmethod
    def _one_name(cls, do: object) -> object:
        if not isinstance(do, str):
            return do
        return SAME_AS.get(do, do)

    @model_validator(mode="after")
    def _complete(self) -> Request:
        rule = TABLE.get(self.do)  # type: ignore[arg-type]
        if rule:
            needs, takes = rule.needs, rule.takes
        else:
            needs, takes = (_ERRAND_NEEDS.get(self.do, ()), ())
        for name in (
            "value",
            "text",
            "loop",
            "pump",
            "experiment",
            "shape_time_constant_s",
            "setpoint_step_um",
        ):
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
        reason = toml_file.describe_error(error.errors(include_url=False)[0], Request).removeprefix(
            ": "
        )
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
    if type(number) is int and 0 <= number < 2**53:
        return number
    return 0


def _short(reason: str, most: int = 300) -> str:
    """One printable line, which may quote the client."""
    clean = "".join(c if c.isprintable() else "?" for c in reason)
    if len(clean) <= most:
        return clean
    return clean[: most - 3] + "..."


_LINE_S = 5.0  # to complete a line
_CHUNK_BYTES = 4096  # read at once: at most a few hundred short lines, 0.3 ms
# A reader this far behind is dropped: a 10 Hz watcher after a minute
_UNREAD_BYTES = 1 << 20


class SlowReaderError(ConnectionError):
    """The peer has not read for too long."""


class Wire:
    """Reads and writes lines."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self._part = b""  # of a line that is not complete yet

    @classmethod
    async def on(cls, connection: socket.socket) -> Wire:
        """Take over an accepted connection. Raises OSError."""
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader(limit=MESSAGE_BYTES, loop=loop)
        protocol = asyncio.StreamReaderProtocol(reader, loop=loop)
        transport, _ = await loop.connect_accepted_socket(lambda: protocol, connection)
        return cls(reader, asyncio.StreamWriter(transport, protocol, reader, loop))

    async def lines(self) -> list[bytes] | None:
        """The complete lines that have arrived, at least one; None when the peer has gone.

        Raises RequestError if a line is too long or too slow.
        """
        begun_s: float | None = None
        while True:
            # A peer may be silent for hours between lines, but not within one.
            now_s = asyncio.get_running_loop().time()
            if self._part and begun_s is None:
                begun_s = now_s
            left_s = None if begun_s is None else begun_s + _LINE_S - now_s
            try:
                # not `wait_for`, which loses a cancellation that coincides with its result
                async with asyncio.timeout(left_s):
                    chunk = await self._reader.read(_CHUNK_BYTES)
            except TimeoutError:
                raise RequestError(f"a message must be complete within {_LINE_S:g} s") from None
            except OSError:
                return None
            if not chunk:
                return None
            *complete, self._part = (self._part + chunk).split(b"\n")
            longest = max(map(len, (*complete, self._part)))
            if longest >= MESSAGE_BYTES:
                raise RequestError(f"a message may have at most {MESSAGE_BYTES} bytes")
            if complete:
                return complete

    @property
    def unread_bytes(self) -> int:
        """What was sent and not yet taken by the peer's system."""
        return self._writer.transport.get_write_buffer_size()

    def send(self, message: dict[str, Any]) -> None:
        """Send without waiting. Raises SlowReaderError (and ends the connection) if too much is
        unread.
        """
        transport = self._writer.transport
        if transport.is_closing():
            return
        if transport.get_write_buffer_size() > _UNREAD_BYTES:
            transport.abort()
            raise SlowReaderError("does not read its messages")
        self._writer.write(encode(message))

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


_RANK: dict[str, int] = {"read": 0, "operate": 1, "tune": 2}
_ERRANDS: dict[str, Role] = {
    "status": "read",
    "watch": "read",
    "claim": "operate",
    "release": "operate",
    "quiet": "operate",
}

# These need no command: what makes the mirror safe is always accepted, and the others move nothing
FREE = frozenset({"status", "watch", "unlock", "mark", "release", "quiet"}) | SAFETY


@dataclass(frozen=True, slots=True)
class Peer:
    """The peer of a connection: `unix:NAME`, as given by the system."""

    who: str
    role: Role
    pid: int | None = field(default=None, compare=False)  # of its process, if it is on this machine
    is_own_user: bool = False  # a process of the hold's own user on the socket file

    @property
    def session(self) -> str:
        """What identifies the sender of a lock for people: its process;
        empty if that is unknown.
        """
        if self.pid is None:
            return ""
        return f"process {self.pid}"


@dataclass(frozen=True, slots=True)
class Sender:
    """Who sends a request: the peer itself, or somebody for whom it sends it."""

    who: str  # for people and for the record
    role: Role
    account: str = ""  # login, by which an author is known; empty: none, or not proven
    session: str = ""
    from_person: bool = True  # False: a bridge's


def sender_of(peer: Peer, on_behalf: OnBehalf | None) -> Sender:
    """Return who sends a request, with the lower of the two roles.

    Parameters
    ----------
    peer : Peer
        Of the connection, as the system identifies it.
    on_behalf : OnBehalf or None
        What the request itself states.

    Returns
    -------
    Sender
    """
    if on_behalf is None:
        return Sender(peer.who, peer.role, account=peer.who, session=peer.session)
    role = min(peer.role, on_behalf.role, key=_RANK.__getitem__)
    from_person = on_behalf.via != "bridge"
    if (
        not peer.is_own_user
    ):  # anybody could state this: it proves no login, and the peer sends it for somebody else
        return Sender(peer.who, role, session=peer.session, from_person=from_person)
    who = f"{on_behalf.via}:{on_behalf.account or on_behalf.name}"
    account = who if from_person and on_behalf.account else ""
    if on_behalf.viewer:
        who = f"{who} for {on_behalf.viewer}"
    return Sender(who, role, account, on_behalf.session, from_person)


def role_includes(role: str, needed: Role) -> bool:
    """Whether a role includes the needed one; an unknown role is `read`."""
    return _RANK.get(role, 0) >= _RANK[needed]


def explain_missing_role(sender: Peer | Sender, do: RequestName) -> str:
    """Why the sender's role forbids this request; empty if it does not."""
    needed = TABLE[do].role if do in TABLE else _ERRANDS[do]
    if role_includes(sender.role, needed):
        return ""
    return f"{do} needs the role {needed}; {sender.who} has {sender.role}"
