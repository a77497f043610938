"""One JSON object a line in either direction, and the limits that keep a message from costing a tick.

A request carries a number; its answer carries the same. What comes without a number was not asked for: the greeting,
notices, and what `watch` streams.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, Field, ValidationError, model_validator

from membrane_ctrl.commands import Kind
from membrane_ctrl.config_file import describe
from membrane_ctrl.section import Section

VERSION = 1

# The longest honest message is `gains` with every key of the loop: 900 bytes. 8 kB are parsed in 0.1 ms.
MESSAGE_BYTES = 8192

# who, why and text go into one event, and JSON makes up to 3 bytes of one in UTF-8: together they fit its slot
WHO_BYTES, WHY_BYTES, TEXT_BYTES = 64, 300, 500

Errand = Literal["status", "watch", "release", "quiet"]
Action = Literal[Kind, Errand]

KINDS: tuple[Kind, ...] = get_args(Kind)
ACTIONS: tuple[str, ...] = (*KINDS, *get_args(Errand))


_NEEDED = {"value": ("setpoint", "manual"), "text": ("mark",), "loop": ("gains",), "experiment": ("tune",)}
_OPTIONAL = {"value": ("gains",), "text": ("latch",)}


class RequestError(ValueError):
    """A message that is no request; the text is the answer."""

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


class Request(Section):
    """What a client sends.

    Attributes
    ----------
    number : int
        Chosen by the client, returned with the answer.
    do : str
        A command of `commands.TABLE`, or an errand: `status` once, `watch` (the status again and again), `release`
        (give the command back), `quiet` (acknowledge the alarms).
    why : str
        Recorded with the command.
    value : float or None
        `setpoint`: um. `manual`: um/s. `gains`: s on trial, until they are kept or go back.
    text : str
        `mark`: what to write. `latch`: why nobody may hold the mirror.
    loop : dict or None
        `gains`: the keys of `[loop]` that change.
    experiment : dict or None
        `tune`: an `ExperimentSpec`.
    take_over : bool
        Take the command from whoever has it.
    period_s : float
        `watch`: from status to status.
    """

    number: Annotated[int, Field(ge=0, lt=2**53)] = 0
    do: Action
    why: Annotated[str, _words(WHY_BYTES)] = ""
    value: float | None = None
    text: Annotated[str, _words(TEXT_BYTES)] = ""
    loop: dict[str, bool | float] | None = None
    experiment: dict[str, str | int | float] | None = None
    take_over: bool = False
    period_s: Annotated[float, Field(ge=0.1, le=3600)] = 1.0

    @model_validator(mode="after")
    def _complete(self) -> Request:
        for name, kinds in _NEEDED.items():
            given = getattr(self, name) not in (None, "")
            if given and self.do not in (*kinds, *_OPTIONAL.get(name, ())):
                raise ValueError(f"{self.do} takes no {name}")
            if not given and self.do in kinds:
                raise ValueError(f"{self.do}: {name} missing")
        return self


def parse(line: bytes) -> Request:
    """The request in a line. Raises RequestError with one line that says what is wrong."""
    try:
        return Request.model_validate_json(line, strict=True)
    except ValidationError as error:
        reason = describe(error.errors(include_url=False)[0], Request).removeprefix(": ")
        raise RequestError(_short(reason), _number_in(line)) from None


def encode(message: dict[str, Any]) -> bytes:
    """A message as a line."""
    return json.dumps(message, allow_nan=False, default=str).encode() + b"\n"


def _number_in(line: bytes) -> int:
    """The number of a request that is wrong in another place, so that its sender knows which one was meant."""
    try:
        number = json.loads(line)["number"]
    except (ValueError, TypeError, LookupError, RecursionError):
        return 0
    return number if type(number) is int and 0 <= number < 2**53 else 0


def _short(reason: str, most: int = 300) -> str:
    """One printable line; what a client sent may be quoted in it."""
    clean = "".join(c if c.isprintable() else "?" for c in reason)
    return clean if len(clean) <= most else clean[: most - 3] + "..."
