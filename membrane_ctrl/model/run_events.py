"""Events of the processes around the controller, and reading of all kinds."""

import math
from typing import Any

from membrane_ctrl.model.events import KINDS, Event, EventLine, keys

# The control process.


class Started(Event, kind="start"):
    """The run begins."""

    devices: str
    priority: str
    message: str


class Ended(Event, kind="end"):
    """The run is over; a recorder that is left alone knows only that."""

    exit: str
    exit_code: int | None = None
    ticks: int | None = None
    missed_ticks: int | None = None


class NoClaim(Event, kind="no_claim"):
    """The board cannot be claimed for one program."""

    message: str


class Link(Event, kind="link"):
    """The link to the board has failed, or is there again."""

    message: str
    up: bool


class InputsNotRecorded(Event, kind="inputs_not_recorded"):
    """There will be no replay of some ticks."""

    message: str


class ShapeUnreadable(Event, kind="shape_unreadable"):
    """A message of the acquisition is none."""

    message: str


class LatchFailed(Event, kind="latch_failed"):
    """The latched fault's file could not be written."""

    message: str


class LatchWritten(Event, kind="latch_written"):
    """Now it could."""


# Child processes.


class Alive(Event, kind="alive"):
    """A child is at work; only on its pipe."""

    for_s: float


class ChildEnded(Event, kind="child_ended"):
    """A child process has ended."""

    child: str
    exit_code: int | None


class ChildSilent(Event, kind="child_silent"):
    """It has not said that it is alive."""

    child: str
    overdue_s: float
    killed: bool


class ChildRestarted(Event, kind="child_restarted"):
    """Another one is in its place."""

    child: str
    restarts: int


class ChildGivenUp(Event, kind="child_given_up"):
    """It has ended too often in an hour."""

    child: str
    restarts: int


# Acquisition.


class AcquisitionState(Event, kind="acquisition"):
    """What the acquisition does, in words for a person."""

    state: str
    message: str
    cycle: int | None = None
    traceback: str | None = None


class GeometryInForce(Event, kind="geometry"):
    """Which geometry the cycles measure with."""

    hash: str
    file: str | None
    calibrated_utc: str | None
    message: str


class Capture(Event, kind="capture"):
    """What became of a set that was asked for: where it is, or why there is none."""

    cycle: int | None = None
    set: str | None = None
    displacement_um: float | None = None
    verdict: str | None = None
    reason: str | None = None
    failed: str | None = None


class RawFrames(Event, kind="raw_frames"):
    """Frames around a fault are not kept."""

    left_out: int
    message: str


# Recorder.


class RecorderError(Event, kind="recorder_error"):
    """Something is not recorded; `what` has trouble."""

    what: str
    message: str


class DiskLow(Event, kind="disk_low"):
    """Soon it will not be."""

    what: str
    message: str


class RecorderRecovered(Event, kind="recorder_recovered"):
    """`what` works again."""

    what: str
    message: str


class RunDeleted(Event, kind="run_deleted"):
    """An old run has made room."""

    run: str
    message: str


class RecorderDone(Event, kind="recorder_done"):
    """The recorder's account; comes after the last line of the file."""

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
    """A listener, or one client of it, is in trouble."""

    port: str
    message: str
    again_s: float | None = None


class PortOpen(Event, kind="port_open"):
    """The listener works again."""

    port: str


class Commander(Event, kind="commander"):
    """Who has the command now, and who had it."""

    who: str | None
    former: str | None
    why: str


class Refused(Event, kind="refused"):
    """The port has refused a request, and others that are not recorded."""

    who: str
    command: str
    why: str
    reason: str
    and_unrecorded: int | None = None


class AlarmsAcknowledged(Event, kind="alarms_acknowledged"):
    """Somebody has seen all that stands."""

    who: str
    why: str


class AlarmTold(Event, kind="alarm"):
    """People were told of an alarm."""

    alarm: str
    what: str
    severity: str
    text: str
    to: str
    sent: bool
    escalated: bool


# Reading.


CONNECTED_AGAIN = "connected again"
_EMPTY: dict[object, object] = {str: "", int: 0, float: math.nan, bool: False}


class UnknownEvent(Event):
    """Of a kind that a later version may know, or not as that kind is."""

    line: EventLine

    @property
    def kind(self) -> str:
        """As in the line; "?" if it has none."""
        return str(self.line.get("kind", "?"))

    def to_dict(self) -> EventLine:
        """The line as it came."""
        return dict(self.line)


def from_dict(line: EventLine) -> Event:
    """The event of a line; never raises, and leaves the line's times to who asks.

    What an earlier version did not write is empty; what cannot be understood is an `UnknownEvent`.
    """
    cls = KINDS.get(line["kind"]) if isinstance(line.get("kind"), str) else None
    if cls is None:
        return UnknownEvent(line)
    values = {}
    for field, key in keys(cls):
        value = values[field.name] = line[key] if key in line else _EMPTY.get(field.type)
        if not _fits(value, field.type):
            return UnknownEvent(line)
    if cls is Link and "up" not in line:  # before it had a field of its own the words were all there was
        values["up"] = values["message"] == CONNECTED_AGAIN
    return cls(**values)


def _fits(value: object, hint: Any) -> bool:
    return hint is Any or isinstance(value, hint) or (isinstance(value, int) and isinstance(0.0, hint))
