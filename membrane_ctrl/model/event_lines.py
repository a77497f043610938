"""Reads events from the lines of `events.jsonl` and from ring messages.

Importing this module defines the events of all kinds.
"""

import json
import math
from enum import StrEnum
from typing import Any, get_origin

from membrane_ctrl.model import (  # noqa: F401 - importing a module defines its kinds
    acquisition_events,
    child_events,
    events,
    port_events,
    recorder_events,
)
from membrane_ctrl.model.event_base import KINDS, Event, EventLine, UnknownEvent
from membrane_ctrl.model.run_events import UnreadableEvent

_EMPTY: dict[object, object] = {str: "", int: 0, float: math.nan, bool: False}


def parse_event(message: bytes) -> EventLine:
    """The event in a ring message; anything but a JSON object becomes an `UnreadableEvent`."""
    try:
        event = json.loads(message)
    except (ValueError, RecursionError):
        event = None
    if isinstance(event, dict):
        return event
    return UnreadableEvent(repr(message[:200])).to_dict()


def from_dict(logged: EventLine) -> Event:
    """The event of a line, without its times; never raises.

    Keys that a line lacks are empty; anything unintelligible is an `UnknownEvent`.
    """
    cls = None
    if isinstance(logged.get("kind"), str):
        cls = KINDS.get(logged["kind"])
    if cls is None:
        return UnknownEvent(logged)
    try:
        values = {field.name: _read_value(logged, key, field.type) for field, key in cls.keys}
    except ValueError:
        return UnknownEvent(logged)
    return cls(**values)


def _read_value(logged: EventLine, key: str, hint: Any) -> object:
    """The value of a key, of its declared type. Raises ValueError if it is of another type."""
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        if key in logged:
            return hint(logged[key])
        return next(iter(hint))
    if get_origin(hint) is tuple:
        texts = logged.get(key, ())
        if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
            raise ValueError(f"{key} is no list of texts")
        return tuple(texts)
    value = logged[key] if key in logged else _EMPTY.get(hint)
    if hint is Any or isinstance(value, hint) or (isinstance(value, int) and isinstance(0.0, hint)):
        return value
    raise ValueError(f"{key} is of another type")
