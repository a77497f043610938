"""Events of the controller, one class per kind; `run_events` has those of the processes around it.

As JSON they are the lines of `events.jsonl`, without their times. A field is a key of the line (`from_` is "from", a
Python keyword). Keys with None as default are omitted if None.
"""

from dataclasses import MISSING, Field, dataclass, fields
from typing import Any, ClassVar, dataclass_transform

EventLine = dict[str, Any]  # of `events.jsonl`, with or without its times

KINDS: dict[str, type["Event"]] = {}


@dataclass_transform(frozen_default=True)
@dataclass(frozen=True)
class Event:
    """The base of all kinds; derived classes are frozen dataclasses."""

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
        """Kind as in the line."""
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
    """The operator's line changed."""

    why: str


class Fault(Event, kind="fault"):
    """A rule of the safety table tripped."""

    code: int
    name: str
    cause: str
    seen: str
    limit: str
    rung: str
    latching: bool
    remedy: str


class Cleared(Event, kind="cleared"):
    """The cause of a fault that only held the flow has gone."""

    name: str


class Resumed(Event, kind="resumed"):
    """A latched fault was cleared by the resume rule."""

    name: str


class ShapeLoopState(Event, kind="shape"):
    """The shape loop's state, or the reason for it, changed."""

    state: str
    reason: str


class CommandTaken(Event, kind="command"):
    """A tick executed or refused a command."""

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
    """Something is wearing out, or will need attention."""

    name: str
    message: str


class MaintenanceOver(Event, kind="maintenance_over"):
    """A maintenance notice no longer applies."""

    name: str
    message: str
