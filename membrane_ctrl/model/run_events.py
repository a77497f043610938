"""Events of the processes around the controller, and reading of all kinds."""

import json
import math
from typing import Any

from membrane_ctrl.model.events import KINDS, Event, EventLine

# Events of the control process.


class Started(Event, kind="start"):
    """The run starts."""

    devices: str
    priority: str
    message: str


class Ended(Event, kind="end"):
    """The run is over; without the control process the recorder knows only `exit`."""

    exit: str
    exit_code: int | None = None
    ticks: int | None = None
    missed_ticks: int | None = None


class NoClaim(Event, kind="no_claim"):
    """The board cannot reserve itself for one program."""

    message: str


class Link(Event, kind="link"):
    """The link to the board failed or returned."""

    message: str
    up: bool


class InputsNotRecorded(Event, kind="inputs_not_recorded"):
    """Some ticks cannot be replayed."""

    message: str


class ShapeUnreadable(Event, kind="shape_unreadable"):
    """A message of the acquisition is unreadable."""

    message: str


class LatchFailed(Event, kind="latch_failed"):
    """The latched fault's file could not be written."""

    message: str


class LockNotStored(Event, kind="lock_not_stored"):
    """A lock, or its removal, is not on the disk."""

    word: str
    message: str


class LockStored(Event, kind="lock_stored"):
    """A lock, or its removal, that had failed is on the disk now."""

    word: str


class LatchWritten(Event, kind="latch_written"):
    """The latched fault's file is written again."""


# Child processes.


class Alive(Event, kind="alive"):
    """A child's sign of life; sent only on its pipe."""

    for_s: float


class ChildEnded(Event, kind="child_ended"):
    """A child process has ended."""

    child: str
    exit_code: int | None


class ChildSilent(Event, kind="child_silent"):
    """A child has not reported that it is alive."""

    child: str
    overdue_s: float
    killed: bool


class ChildRestarted(Event, kind="child_restarted"):
    """A child was replaced."""

    child: str
    restarts: int


class ChildGivenUp(Event, kind="child_given_up"):
    """A child has ended too often in an hour."""

    child: str
    restarts: int


# Acquisition.


class AcquisitionState(Event, kind="acquisition"):
    """The acquisition's state, in words."""

    state: str
    message: str
    cycle: int | None = None
    traceback: str | None = None


class GeometryInForce(Event, kind="geometry"):
    """The geometry that the cycles use."""

    hash: str
    file: str | None
    calibrated_utc: str | None
    message: str


class Capture(Event, kind="capture"):
    """The result of `capture`: the set's folder, or the reason for its absence."""

    cycle: int | None = None
    set: str | None = None
    displacement_um: float | None = None
    verdict: str | None = None
    reason: str | None = None
    failed: str | None = None


class Vibrations(Event, kind="vibrations"):
    """The mirror's vibrations in a minute of tracked frames; a mode keeps its place, None where it was not heard."""

    frequency_hz: Any  # list of numbers and None
    amplitude_nm: Any  # as above, RMS over the mirror
    message: str


class FramesLeftOut(Event, kind="raw_frames"):
    """Frames around a fault are not kept."""

    left_out: int
    message: str


# Recorder.


class RecorderError(Event, kind="recorder_error"):
    """`what` cannot be recorded."""

    what: str
    message: str


class DiskLow(Event, kind="disk_low"):
    """The disk is almost full."""

    what: str
    message: str


class RecorderRecovered(Event, kind="recorder_recovered"):
    """`what` works again."""

    what: str
    message: str


class RunDeleted(Event, kind="run_deleted"):
    """An old run was deleted to make room."""

    run: str
    message: str


class RecorderDone(Event, kind="recorder_done"):
    """The recorder's summary; comes after the last line of the file."""

    dropped: Any
    segments: Any
    tables: Any
    errors: Any
    rows_lost: Any
    column_rows_lost: Any
    events_lost: Any
    input_ticks_lost: Any
    restarts: Any
    folder_anew_s: Any
    partial: Any


# Control port and alarms.


class PortAddresses(Event, kind="port"):
    """Where the control port listens."""

    socket: str | None = None
    tls: str | None = None
    metrics: str | None = None


class PortFailed(Event, kind="port_failed"):
    """A listener or one of its clients failed."""

    port: str
    message: str
    again_s: float | None = None


class PortOpen(Event, kind="port_open"):
    """The listener works again."""

    port: str


class CommanderChanged(Event, kind="commander"):
    """Who has command now, and who had it before."""

    who: str | None
    former: str | None
    why: str


class Refused(Event, kind="refused"):
    """The port refused a request, and perhaps others not recorded."""

    who: str
    command: str
    why: str
    reason: str
    and_unrecorded: int | None = None


class AlarmsAcknowledged(Event, kind="alarms_acknowledged"):
    """Somebody acknowledged all alarms."""

    who: str
    why: str


class AlarmTold(Event, kind="alarm"):
    """An alarm's notice was sent, or failed."""

    alarm: str
    what: str
    severity: str
    text: str
    to: str
    sent: bool
    escalated: bool


# People, during the run or after it.


class Mark(Event, kind="mark"):
    """A remark on a moment of the run."""

    text: str
    who: str
    made_utc: str | None = None  # after the run


CONNECTED_AGAIN = "connected again"
_EMPTY: dict[object, object] = {str: "", int: 0, float: math.nan, bool: False}


class UnknownEvent(Event):
    """An event of an unknown kind, or with unexpected fields."""

    line: EventLine

    @property
    def kind(self) -> str:
        """Kind as in the line; "?" if missing."""
        return str(self.line.get("kind", "?"))

    def to_dict(self) -> EventLine:
        """The line, unchanged."""
        return dict(self.line)


def parse(message: bytes) -> EventLine:
    """The event in a ring message; anything but a JSON object becomes an event that says so."""
    try:
        event = json.loads(message)
    except (ValueError, RecursionError):
        event = None
    return event if isinstance(event, dict) else {"kind": "unreadable_event", "message": repr(message[:200])}


def from_dict(line: EventLine) -> Event:
    """The event of a line, without its times; never raises.

    Keys missing in earlier versions are empty; anything unintelligible is an `UnknownEvent`.
    """
    cls = KINDS.get(line["kind"]) if isinstance(line.get("kind"), str) else None
    if cls is None:
        return UnknownEvent(line)
    values = {}
    for field, key in cls.keys:
        value = values[field.name] = line[key] if key in line else _EMPTY.get(field.type)
        if not _fits(value, field.type):
            return UnknownEvent(line)
    if cls is Link and "up" not in line:  # earlier versions had only the words
        values["up"] = values["message"] == CONNECTED_AGAIN
    return cls(**values)


def _fits(value: object, hint: Any) -> bool:
    return hint is Any or isinstance(value, hint) or (isinstance(value, int) and isinstance(0.0, hint))
