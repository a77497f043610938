"""Events of the processes around the controller, and reading of all kinds."""

import json
import math
from enum import StrEnum
from typing import Any, get_origin

from membrane_ctrl.model.event_base import KINDS, Event, EventLine, LogLevel, UnknownEvent
from membrane_ctrl.model.notices import GLITCH_S, NoticeChanges, NoticeKey, Notices, Topic

_ENDED_WELL = frozenset({"done", "interrupted"})
_EMPTY: dict[object, object] = {str: "", int: 0, float: math.nan, bool: False}


# Events of the control process.


class Started(
    Event,
    kind="start",
    sentence="Run started[ on {devices}][, {priority} priority][; {message}][; {program}]",
    notable=True,
):
    """The run starts, under a program with its commit."""

    devices: str
    priority: str
    message: str
    program: str | None = None


class Ended(
    Event,
    kind="end",
    sentence="Run ended: {exit}",
    opens=(Topic.RUN_END,),
    severity="critical",
    notable=True,
    urgent=True,
):
    """The run is over; without the control process the recorder knows only `exit`."""

    exit: str
    exit_code: int | None = None
    ticks: int | None = None
    missed_ticks: int | None = None

    @property
    def stands(self) -> bool:
        """Whether it ended by itself, not because a person or its duration ended it."""
        return self.exit not in _ENDED_WELL


class NoClaim(Event, kind="no_claim", level=LogLevel.WARNING):
    """The board cannot reserve itself for one program."""

    message: str


class Link(
    Event,
    kind="link",
    sentence="Link to the pump board: {message}",
    opens=(Topic.LINK,),
    closes=(Topic.LINK,),
    delay_s=GLITCH_S,
):
    """The link to the board failed or returned."""

    message: str
    up: bool

    @property
    def stands(self) -> bool:
        """Whether it failed."""
        return not self.up

    @property
    def level(self) -> LogLevel:
        """A failure is a warning."""
        return LogLevel.INFO if self.up else LogLevel.WARNING


class InputsNotRecorded(Event, kind="inputs_not_recorded", level=LogLevel.WARNING):
    """Some ticks cannot be replayed."""

    message: str


class SnapshotNotRecorded(Event, kind="snapshot_not_recorded", level=LogLevel.WARNING):
    """No replay can start at this moment; later snapshots may be recorded."""

    message: str


class ShapeUnreadable(Event, kind="shape_unreadable", level=LogLevel.WARNING):
    """A message of the acquisition is unreadable."""

    message: str


class UnreadableEvent(Event, kind="unreadable_event", level=LogLevel.ERROR):
    """A message that is no event."""

    message: str


class LatchFailed(
    Event,
    kind="latch_failed",
    sentence="The latched fault is not on the disk: {message}. Do: mend the disk; until then the next "  # noqa: E501
    "start would "
    "not see the fault",
    level=LogLevel.ERROR,
    opens=(Topic.LATCH,),
    severity="critical",
):
    """The latched fault's file could not be written."""

    message: str


class LatchWritten(
    Event,
    kind="latch_written",
    sentence="The latched fault's file is written again",
    closes=(Topic.LATCH,),
):
    """The latched fault's file is written again."""


class LockNotStored(
    Event,
    kind="lock_not_stored",
    sentence="The lock {word} is not stored: {message}. Do: mend the disk; until then only this run "  # noqa: E501
    "knows the lock",
    level=LogLevel.ERROR,
    opens=(Topic.LOCK_STORAGE,),
    subject="word",
    severity="critical",
):
    """A lock, or its removal, is not on the disk."""

    word: str
    message: str


class LockStored(
    Event,
    kind="lock_stored",
    sentence="The lock {word} is stored",
    closes=(Topic.LOCK_STORAGE,),
    subject="word",
):
    """A lock, or its removal, that had failed is on the disk."""

    word: str


# Child processes.


class Alive(Event, kind="alive", sentence="Alive for {for_s:g} s"):
    """A child's sign of life; sent only on its pipe."""

    for_s: float


class ChildEnded(
    Event,
    kind="child_ended",
    sentence="The {child} process ended[ with exit code {exit_code}]; the hold continues",
    level=LogLevel.WARNING,
    opens=(Topic.CHILD,),
    subject="child",
    delay_s=GLITCH_S,
):
    """A child process has ended."""

    child: str
    exit_code: int | None


class ChildSilent(
    Event,
    kind="child_silent",
    sentence="The {child} process does not answer; the hold continues",
    level=LogLevel.WARNING,
    opens=(Topic.CHILD,),
    subject="child",
    delay_s=GLITCH_S,
):
    """A child has not reported that it is alive."""

    child: str
    overdue_s: float
    killed: bool


class ChildRestarted(
    Event,
    kind="child_restarted",
    sentence="The {child} process was replaced (replacement {restarts})",
    closes=(Topic.CHILD, Topic.RECORDING),
    subject="child",
):
    """A child was replaced."""

    child: str
    restarts: int

    def notice_changes(self, standing: Notices) -> NoticeChanges:
        """End the notice of the child; a new recorder reports again what fails, so end those of the
        former one.
        """
        closed = [NoticeKey(Topic.CHILD, self.child)]
        if self.child == RECORDER:
            closed += [key for key in standing if key.topic is Topic.RECORDING]
        return NoticeChanges(closed=tuple(closed))


class ChildGivenUp(
    Event,
    kind="child_given_up",
    sentence="The {child} process ended too often and is not replaced for an hour. Do: check the run",  # noqa: E501
    level=LogLevel.ERROR,
    opens=(Topic.CHILD,),
    subject="child",
):
    """A child has ended too often in an hour."""

    child: str
    restarts: int


# Acquisition.


class AcquisitionState(Event, kind="acquisition", sentence="Acquisition {state}[: {message}]"):
    """The acquisition's state, in words."""

    state: str
    message: str
    cycle: int | None = None
    traceback: str | None = None

    @property
    def level(self) -> LogLevel:
        """A failure is an error; a camera that does not answer yet is a warning."""
        return {"failed": LogLevel.ERROR, "retrying": LogLevel.WARNING}.get(
            self.state, LogLevel.INFO
        )

    @property
    def notable(self) -> bool:
        """Whether it differs from the usual state."""
        return self.state != "running"


class GeometryInForce(
    Event,
    kind="geometry",
    sentence="Geometry {hash}[ from {file}][, calibrated {calibrated_utc}][; {message}]",
    notable=True,
):
    """The geometry that the cycles use."""

    hash: str
    file: str | None
    calibrated_utc: str | None
    message: str


class Capture(
    Event,
    kind="capture",
    sentence="Capture[ of cycle {cycle}][ in {set}][, {verdict}][: {reason}][. Failed: {failed}]",
    notable=True,
):
    """The result of `capture`: the set's folder, or the reason for its absence."""

    cycle: int | None = None
    set: str | None = None
    displacement_um: float | None = None
    verdict: str | None = None
    reason: str | None = None
    failed: str | None = None


class Vibrations(Event, kind="vibrations", sentence="Vibrations of the mirror: {message}"):
    """The mirror's vibrations in a minute of tracked frames; a mode keeps its place, None where it
    was not heard.
    """

    frequency_hz: Any  # list of numbers and None
    amplitude_nm: Any  # as above, RMS over the mirror
    message: str


class FramesLeftOut(Event, kind="raw_frames", level=LogLevel.WARNING):
    """Frames around a fault are not kept."""

    left_out: int
    message: str


# Recorder.

RECORDER = "recorder"  # its name as a child


class RecorderError(
    Event,
    kind="recorder_error",
    sentence="Not recorded: {message}. Do: check the disk and the folder of the run",
    level=LogLevel.ERROR,
    opens=(Topic.RECORDING,),
    subject="what",
):
    """`what` cannot be recorded."""

    what: str
    message: str


class DiskLow(
    Event,
    kind="disk_low",
    sentence="Disk almost full: {message}",
    level=LogLevel.WARNING,
    opens=(Topic.RECORDING,),
    subject="what",
):
    """The disk is almost full."""

    what: str
    message: str


class RecorderRecovered(
    Event, kind="recorder_recovered", closes=(Topic.RECORDING,), subject="what"
):
    """`what` works again."""

    what: str
    message: str


class RunDeleted(Event, kind="run_deleted"):
    """An old run was deleted to make room."""

    run: str
    message: str


class RecorderDone(Event, kind="recorder_done", sentence="Recorder done"):
    """The recorder's summary; comes after the last line of the file."""

    dropped: Any
    segments: Any
    tables: Any
    errors: Any
    rows_lost: Any
    table_rows_lost: Any
    events_lost: Any
    input_ticks_lost: Any
    restarts: Any
    folder_anew_s: Any
    partial: Any


# Control port and alarms.


class PortAddresses(
    Event, kind="port", sentence="Control port open[ on {socket}][, TLS {tls}][, metrics {metrics}]"
):
    """Where the control port listens."""

    socket: str | None = None
    tls: str | None = None
    metrics: str | None = None


class PortFailed(
    Event,
    kind="port_failed",
    sentence="Control port {port} failed: {message}[. Tries again in {again_s:g} s]",
    level=LogLevel.WARNING,
    opens=(Topic.PORT,),
    subject="port",
    delay_s=GLITCH_S,
):
    """A listener or one of its clients failed."""

    port: str
    message: str
    again_s: float | None = None

    @property
    def stands(self) -> bool:
        """Whether the listener failed, which ends with `PortOpen`; a failed client is gone."""
        return self.again_s is not None


class PortOpen(
    Event,
    kind="port_open",
    sentence="Control port {port} works again",
    closes=(Topic.PORT,),
    subject="port",
):
    """The listener works again."""

    port: str


class CommanderChanged(
    Event, kind="commander", sentence="Control taken by {who}[ (previously {former})][: {why}]"
):
    """Who has command now, and who had it before."""

    who: str | None
    former: str | None
    why: str

    def _choose_template(self) -> str:
        return self._template if self.who else "Control released[ by {former}][: {why}]"


class Refused(
    Event, kind="refused", sentence="Refused {command} of {who}: {reason}", level=LogLevel.WARNING
):
    """The port refused a request, and perhaps others not recorded."""

    who: str
    command: str
    why: str
    reason: str
    and_unrecorded: int | None = None


class AlarmsAcknowledged(
    Event,
    kind="alarms_acknowledged",
    sentence="Alarms acknowledged by {who}[: {why}]",
    notable=True,
):
    """Somebody acknowledged all alarms."""

    who: str
    why: str


class AlarmTold(Event, kind="alarm", sentence="Alarm {alarm}[ to {to}]: {text}"):
    """An alarm's notice was sent, or failed."""

    alarm: str
    what: str
    severity: str
    text: str
    to: str
    sent: bool
    escalated: bool


# People, during the run or after it.


class Mark(Event, kind="mark", sentence="Mark[ by {who}]: {text}", notable=True):
    """A remark on a moment of the run."""

    text: str
    who: str
    made_utc: str | None = None  # after the run

    @property
    def plot_mark(self) -> str:
        """A line of marks."""
        return "mark"


def parse(message: bytes) -> EventLine:
    """The event in a ring message; anything but a JSON object becomes an event that says so."""
    try:
        event = json.loads(message)
    except (ValueError, RecursionError):
        event = None
    return event if isinstance(event, dict) else UnreadableEvent(repr(message[:200])).to_dict()


def from_dict(line: EventLine) -> Event:
    """The event of a line, without its times; never raises.

    Keys that a line lacks are empty; anything unintelligible is an `UnknownEvent`.
    """
    cls = KINDS.get(line["kind"]) if isinstance(line.get("kind"), str) else None
    if cls is None:
        return UnknownEvent(line)
    try:
        values = {field.name: _read_value(line, key, field.type) for field, key in cls.keys}
    except ValueError:
        return UnknownEvent(line)
    return cls(**values)


def _read_value(line: EventLine, key: str, hint: Any) -> object:
    """The value of a key, of its declared type. Raises ValueError if it is of another type."""
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        return hint(line[key]) if key in line else next(iter(hint))
    if get_origin(hint) is tuple:
        texts = line.get(key, ())
        if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
            raise ValueError(f"{key} is no list of texts")
        return tuple(texts)
    value = line[key] if key in line else _EMPTY.get(hint)
    if hint is Any or isinstance(value, hint) or (isinstance(value, int) and isinstance(0.0, hint)):
        return value
    raise ValueError(f"{key} is of another type")
