"""Events of the controller, one class a kind; `run_events` has those of the processes around it.

As JSON they are the lines of `events.jsonl`, without their times. A field is a key of the line (`from_` is "from",
which is a word of Python). Keys with None as default are left out when there is nothing to say.
"""

from dataclasses import MISSING, Field, dataclass, fields
from typing import Any, ClassVar, dataclass_transform

EventLine = dict[str, Any]  # of `events.jsonl`, with or without its times

KINDS: dict[str, type["Event"]] = {}


@dataclass_transform(frozen_default=True)
@dataclass(frozen=True)
class Event:
    """The base of all kinds; a class derived from it is a frozen dataclass."""

    _kind: ClassVar[str]
    keys: ClassVar[tuple[tuple[Field[Any], str], ...]]  # the fields, each with its key in the line

    def __init_subclass__(cls, kind: str = "") -> None:
        dataclass(frozen=True)(cls)
        cls._kind = kind
        cls.keys = tuple((field, field.name.rstrip("_")) for field in fields(cls))
        if kind:
            KINDS[kind] = cls

    @property
    def kind(self) -> str:
        """As in the line."""
        return self._kind

    def to_dict(self) -> EventLine:
        """The line, without its times."""
        told = ((key, getattr(self, field.name), field.default is MISSING) for field, key in self.keys)
        return {"kind": self.kind} | {key: value for key, value, always in told if always or value is not None}


class StateEntered(Event, kind="state"):
    """The state machine entered another state."""

    state: str
    from_: str
    why: str


class Why(Event, kind="why"):
    """The operator's line has changed."""

    why: str


class Fault(Event, kind="fault"):
    """A rule of the safety table has tripped."""

    code: int
    name: str
    cause: str
    seen: str
    limit: str
    rung: str
    latching: bool
    remedy: str


class Cleared(Event, kind="cleared"):
    """The cause of a fault that only held the flow is gone."""

    name: str


class Resumed(Event, kind="resumed"):
    """A latched fault was cleared by the resume rule."""

    name: str


class ShapeLoopState(Event, kind="shape"):
    """The shape loop has another state, or another reason for it."""

    state: str
    reason: str


class CommandTaken(Event, kind="command"):
    """A tick has obeyed or refused a command."""

    command: str
    who: str
    why: str
    value: float | None = None
    text: str | None = None
    loop: Any = None
    experiment: Any = None
    refused: str | None = None


class GainsReverted(Event, kind="gains_reverted"):
    """Gains on trial were reverted."""

    why: str


class ExperimentEnded(Event, kind="experiment"):
    """An experiment is over."""

    experiment: str
    completed: bool
    reason: str
    pump_map: Any = None


class Plausibility(Event, kind="plausibility"):
    """Which of laser, gauge and camera is wrong now, if any."""

    liar: str
    seen: str


class Maintenance(Event, kind="maintenance"):
    """Something wears out, or will need a person."""

    name: str
    message: str


class MaintenanceOver(Event, kind="maintenance_over"):
    """A maintenance message no longer holds."""

    name: str
    message: str
