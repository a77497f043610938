"""Events: what the controller tells of, one class a kind; `run_events` has those of the processes around it.

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
    """What all kinds have in common; a class derived from it is a frozen dataclass."""

    _kind: ClassVar[str]

    def __init_subclass__(cls, kind: str = "") -> None:
        dataclass(frozen=True)(cls)
        cls._kind = kind
        if kind:
            KINDS[kind] = cls

    @property
    def kind(self) -> str:
        """As in the line."""
        return self._kind

    def to_dict(self) -> EventLine:
        """The line, without its times."""
        told = ((key, getattr(self, field.name), field.default is MISSING) for field, key in keys(type(self)))
        return {"kind": self.kind} | {key: value for key, value, always in told if always or value is not None}


def keys(cls: type[Event]) -> tuple[tuple[Field[Any], str], ...]:
    """The fields of a kind, and their keys in the line."""
    return tuple((field, field.name.rstrip("_")) for field in fields(cls))


# The controller.


class StateEntered(Event, kind="state"):
    """The state machine has gone into another state."""

    state: str
    from_: str
    why: str


class Why(Event, kind="why"):
    """The operator's line has changed for good."""

    why: str


class Fault(Event, kind="fault"):
    """A rule of the safety table has spoken."""

    code: int
    name: str
    cause: str
    seen: str
    limit: str
    rung: str
    latching: bool
    remedy: str


class Cleared(Event, kind="cleared"):
    """What held the flow is over."""

    name: str


class Resumed(Event, kind="resumed"):
    """A latched fault has gone by the resume rule."""

    name: str


class ShapeLoopState(Event, kind="shape"):
    """The outer loop has another state, or another reason for it."""

    state: str
    reason: str


class CommandTaken(Event, kind="command"):
    """A tick has taken up a command: it obeys, or says why not."""

    command: str
    who: str
    why: str
    value: float | None = None
    text: str | None = None
    loop: Any = None
    experiment: Any = None
    refused: str | None = None


class GainsReverted(Event, kind="gains_reverted"):
    """Gains on trial have gone back."""

    why: str


class ExperimentEnded(Event, kind="experiment"):
    """An experiment is over."""

    experiment: str
    completed: bool
    reason: str
    pump_map: Any = None


class Plausibility(Event, kind="plausibility"):
    """Another one of laser, gauge and camera lies, or nobody any more."""

    liar: str
    seen: str


class Maintenance(Event, kind="maintenance"):
    """Something wears out, or needs a person some day."""

    name: str
    message: str


class MaintenanceOver(Event, kind="maintenance_over"):
    """It no longer does."""

    name: str
    message: str
