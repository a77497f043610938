"""What a hold may send to its clients, as schemas: greeting, answers, notices, status and events.

`message_syntax` has checked that a message is bounded, plain JSON; the schemas check the fields
that clients read. A hold of a later version may send further fields; they pass.

Messages stay dictionaries with the keys that were sent.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from membrane_ctrl.control_port.message_syntax import QUOTED_MAX, AnswerError, Message
from membrane_ctrl.controller.command import Role
from membrane_ctrl.model import terminal

Kind = Literal["answer", "notice", "streamed", "unknown"]
COMMAND_TAKEN = "command_taken"  # the code of a notice: another client has taken command
# Short words for the kinds of problems that pydantic names
_PROBLEMS = {
    "missing": "missing",
    "string_pattern_mismatch": "not a name",
    "string_type": "not a text",
    "float_type": "not a number",
    "int_type": "not a whole number",
    "bool_type": "neither true nor false",
    "dict_type": "not a table",
    "model_type": "not a table",
}
# Types of fields
_Name = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,39}$")]
_Number = Annotated[float, Field(strict=True)]
_Count = Annotated[int, Field(strict=True, ge=0)]
_Text = Annotated[str, Field(strict=True)]
# The name of a folder: clients look for the run's files under it
RunName = Annotated[str, StringConstraints(strict=True, pattern=r"^[^/.\x00][^/\x00]{0,199}$")]


class _Part(BaseModel):
    model_config = ConfigDict(extra="allow", frozen=True)


class FaultPart(_Part):
    """A fault in a status."""

    code: _Count
    name: _Text
    cause: _Text
    remedy: _Text


class GeometryPart(_Part):
    """The geometry in use."""

    file: _Text | None = None
    calibrated_utc: _Text | None = None
    hash: _Text = ""
    message: _Text = ""


class GainsPart(_Part):
    """The gains in use."""

    kp_per_s: _Number
    ti_s: _Number
    td_s: _Number


class HeldPart(_Part):
    """What is held besides the centre."""

    holds: _Name
    state: _Name
    reason: _Text = ""


class SessionPart(_Part):
    """The session that has command of the hold."""

    id: _Text
    what: _Text
    who: _Text
    pid: _Count | None = None
    since_utc: _Text


class StandingPart(_Part):
    """A notice that stands (`notices.Notice`)."""

    topic: _Name
    subject: _Text
    severity: _Name
    text: _Text


class StatusPart(_Part):
    """A hold's status (`status.status_table` and `Port.status`)."""

    state: _Name
    why: _Text
    paused: Annotated[bool, Field(strict=True)] = False
    run: RunName | None = None
    fault: FaultPart | None = None
    row: dict[_Name, _Number | None] | None = None
    notices: list[StandingPart] = []
    recording_ok: Annotated[bool, Field(strict=True)] = True
    gains: GainsPart | None = None
    geometry: GeometryPart | None = None
    safe_level: _Name | None = None
    shape: _Name | None = None
    shape_reason: _Text = ""
    held: HeldPart | None = None
    state_age_s: _Number | None = None
    trial_left_s: _Number | None = None
    commander: _Text | None = None
    command_session: SessionPart | None = None
    clients: _Count = 0


class EventPart(_Part):
    """An event; its other keys depend on its kind (`event_lines.from_dict` checks them)."""

    kind: _Name
    mono_s: _Number | None = None


class GreetingPart(_Part):
    """The first message of a hold."""

    membrane_ctrl: Annotated[int, Field(strict=True, ge=1)]
    run: RunName
    you: _Text
    role: Role
    commander: _Text | None = None


class AnswerPart(_Part):
    """The answer to a request."""

    number: _Count
    ok: Annotated[bool, Field(strict=True)]
    refused: _Text | None = None
    state: _Name | None = None
    status: StatusPart | None = None
    loop: dict[str, Any] | None = None
    pump: dict[str, Any] | None = None


class StreamedPart(_Part):
    """A message of `watch`."""

    status: StatusPart | None = None
    event: EventPart | None = None


class NoticePart(_Part):
    """A message for the person at the client; a `code` makes it one for the program as well."""

    notice: _Text
    code: _Name | None = None


def kind_of(message: Message) -> Kind:
    """Return the kind of a message, which its keys show."""
    keys = message.keys()
    if "number" in keys:
        return "answer"
    if "notice" in keys:
        return "notice"
    if "status" in keys or "event" in keys:
        return "streamed"
    return "unknown"


def check_message(message: Message) -> Message:
    """Return a message as it was sent, checked. Raises AnswerError."""
    models: dict[Kind, type[_Part]] = {
        "answer": AnswerPart,
        "notice": NoticePart,
        "streamed": StreamedPart,
        "unknown": _Part,
    }
    return check(message, models[kind_of(message)])


def check_greeting(message: Message) -> Message:
    """Return a greeting, checked. Raises AnswerError."""
    keys = message.keys()
    if "membrane_ctrl" not in keys:
        raise AnswerError("not a control port of membrane-ctrl")
    return check(message, GreetingPart)


def check(message: Message, model: type[BaseModel]) -> Message:
    """Return a decoded message, unchanged, if it fits a model.

    Parameters
    ----------
    message : Message
        From a peer that may be no hold: any JSON object.
    model : type of BaseModel
        Fields that it does not name are allowed: a newer hold may send more.

    Raises
    ------
    AnswerError
        Names the first field that does not fit.
    """
    try:
        model.model_validate(message)
    except ValidationError as error:
        raise AnswerError(_describe_first_error(error)) from None
    return message


def _describe_first_error(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_input=False, include_context=False)[0]
    field = ".".join(str(part) for part in first["loc"])
    problem = _PROBLEMS.get(first["type"]) or first["msg"][:1].lower() + first["msg"][1:]
    return terminal.one_line(f"{field[:QUOTED_MAX]}: {problem}"[: 2 * QUOTED_MAX])
