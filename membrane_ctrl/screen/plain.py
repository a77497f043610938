"""The same for a log file: a line a second, and faults at once."""

from __future__ import annotations

import math

from membrane_ctrl.screen.model import Event, View, text
from membrane_ctrl.screen.words import duration, number, percent

_AT_ONCE = frozenset(
    {"fault", "cleared", "state", "link", "child_ended", "child_silent", "child_restarted", "child_given_up", "end"}
    | {"recorder_error", "disk_low", "recorder_recovered"}  # a disk that takes nothing does not take the event either
)


def line(view: View) -> str:
    """The second in one line."""
    row = view.row
    if view.silent_s or row is None:
        silent = f"control loop silent for {view.silent_s:.1f} s" if row else view.why
        return f"{view.elapsed_s:9.1f} s  {silent}"
    shape = view.shape
    parts = [
        f"{view.elapsed_s:9.1f} s  {view.state.name.lower():7}",
        f"error {number(row.error_um, 2, sign=True):>7} um",
        f"pump {percent(row.pump_fraction):>5}",
        f"leak {number(row.leak_um_per_s, 2)} um/s" + (" TOO TIGHT" if view.too_tight else ""),
        f"shape {_shape_words(view)} trim {number(shape.trim_um, 2, sign=True)} um",
        f"late {number(row.lateness_ms, 1)} ms",
        view.why,
    ]
    if view.recording:
        parts.append(f"RECORDING {view.recording}")
    if math.isfinite(view.left_s):
        parts.append(f"{duration(view.left_s)} left")
    return "  ".join(parts)


def at_once(event: Event) -> bool:
    """Whether nobody should have to wait a second for the event."""
    kind = event.get("kind")
    return kind in _AT_ONCE or (kind == "acquisition" and event.get("state") != "running")


def event_line(event: Event) -> str:
    """An event in one line."""
    mono_s = event.get("mono_s", math.nan)
    what = " ".join(str(event[key]) for key in ("state", "child", "exit") if key in event)
    words = " ".join(f"{what} {text(event)}".split())  # one line, whatever an error said
    remedy = f"; {event['remedy']}" if event.get("remedy") else ""
    return f"{number(mono_s, 1):>9} s  {str(event.get('kind', '?')).upper()} {words}{remedy}".rstrip()


def _shape_words(view: View) -> str:
    shape = view.shape
    if shape.estimate is None:
        return shape.note or shape.state.name.lower()
    return f"{shape.state.name.lower()} {shape.estimate.verdict} {duration(shape.age_s)}"
