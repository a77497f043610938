"""One JSON object per line in either direction, and limits so that no message costs a tick.

A request carries a number; its answer carries the same. Messages without a number are unsolicited:
the greeting, notices, and the stream of `watch`. `session.PortSession` is one client from greeting
to goodbye.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError, field_validator, model_validator

from firmware_iface.settings import Section
from membrane_ctrl.config import toml_file
from membrane_ctrl.controller.command import Kind, Role
from membrane_ctrl.controller.commands import SAME_AS, TABLE

VERSION = 1

# The longest valid message is `gains` with every key of the loop: 900 bytes. 8 kB are parsed in
# 0.1 ms.
MESSAGE_BYTES = 8192

# who, why and text go into one event, and JSON makes up to 3 bytes of one in UTF-8: together they
# fit its slot
WHO_BYTES, WHY_BYTES, TEXT_BYTES = 64, 300, 500

Errand = Literal["status", "watch", "release", "quiet", "claim"]
RequestName = Literal[Kind, Errand]
# The fields that a request of this name must have, beside those of commands
_ERRAND_NEEDS: dict[str, tuple[str, ...]] = {"claim": ("text",)}


class RequestError(ValueError):
    """A message that is not a valid request; the text is the answer."""

    def __init__(self, reason: str, number: int = 0) -> None:
        super().__init__(reason)
        self.number = number


def _make_text_check(most_bytes: int) -> AfterValidator:
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
    account: Annotated[str, _make_text_check(WHO_BYTES - 8)] = ""
    name: Annotated[str, _make_text_check(WHO_BYTES - 8)] = (
        ""  # who it is, for people, if there is no login
    )
    session: Annotated[str, _make_text_check(WHO_BYTES)] = ""  # of that person
    # for whom a program asks, as it states itself
    viewer: Annotated[str, _make_text_check(WHO_BYTES - 8)] = ""
    role: Role


class Request(Section):
    """A client's request."""

    # chosen by the client, returned with the answer
    number: Annotated[int, Field(ge=0, lt=2**53)] = 0
    # a command of `commands.TABLE`, or `status` (once), `watch` (repeated status), `claim` (command
    # for a session, this connection), `release` (give up command), `quiet` (acknowledge the alarms)
    do: RequestName
    why: Annotated[str, _make_text_check(WHY_BYTES)] = ""  # recorded with the command
    value: float | None = None  # `setpoint`: µm. `manual`: µm/s. `gains`: trial time, s
    # `mark`: the remark. `latch`: why the mirror is locked. `unlock`: the lock's word, which a
    # person typed. `claim`: the session's name
    text: Annotated[str, _make_text_check(TEXT_BYTES)] = ""
    loop: dict[str, bool | float] | None = None  # `gains`: the keys of `[loop]` that change
    pump: dict[str, Any] | None = None  # `gains`: the table `[pump]`, if it changes
    # `tune`: an `ExperimentSpec`, which states its fields
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
    def _check_fields(self) -> Request:
        """Refuse a field that the command does not take, and the lack of one that it needs."""
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
    """Parse a request. Raises RequestError with one line that names the mistake."""
    try:
        return Request.model_validate_json(line, strict=True)
    except ValidationError as error:
        reason = toml_file.describe_error(error.errors(include_url=False)[0], Request).removeprefix(
            ": "
        )
        raise RequestError(_shorten_reason(reason), _number_in(line)) from None


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


def _shorten_reason(reason: str, most: int = 300) -> str:
    """One printable line, which may quote the client."""
    clean = "".join(c if c.isprintable() else "?" for c in reason)
    if len(clean) <= most:
        return clean
    return clean[: most - 3] + "..."
