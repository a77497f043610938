"""Events to Rerun: one line of the text log each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from membrane_ctrl.recording.events import Event
from membrane_ctrl.recording.sink import Recording

EVENTS_PATH = "/events"

_LEVELS = {
    "fault": "ERROR",
    "tick_error": "ERROR",
    "recorder_error": "ERROR",
    "unreadable_event": "ERROR",
    "warning": "WARN",
    "disk_low": "WARN",
}
_TIMES = frozenset({"time_utc", "mono_s", "kind"})


def send_events(recording: Recording, events: Sequence[Event]) -> None:
    """Send events in their order."""
    if not events:
        return
    time_s = np.array([event_time_s(event) for event in events])
    texts = [event_text(event) for event in events]
    levels = [_LEVELS.get(str(event.get("kind")), "INFO") for event in events]
    recording.columns(EVENTS_PATH, time_s, rr.TextLog.columns(text=texts, level=levels))


def event_time_s(event: Event) -> float:
    """When it happened on the run's axis; 0 for an event that does not say."""
    mono_s = event.get("mono_s")
    return float(mono_s) if isinstance(mono_s, (int, float)) else 0.0


def event_text(event: Event) -> str:
    """One line: the kind, then what the event says of itself."""
    details = [
        f"{key} {_short(value)}" for key, value in event.items() if key not in _TIMES and value not in (None, "")
    ]
    return f"{event.get('kind', '?')}: {', '.join(details)}" if details else str(event.get("kind", "?"))


def _short(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
