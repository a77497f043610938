"""One row of telemetry per tick, the names of its codes, and the state of the run that follows from rows and events.

`columns` has the table of a row's columns. A row crosses to the other processes as plain doubles, so that writing it
costs the tick a few microseconds. Codes (state, shape state, fault, safe level) are small integers; the order of the
names gives them. The status serves all displays and notices.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from operator import attrgetter
from typing import Any

import numpy as np

from membrane_ctrl.model import events, run_events
from membrane_ctrl.model.arrays import Column, FloatArray
from membrane_ctrl.model.columns import COLUMNS, ColumnValues
from membrane_ctrl.model.lock import Lock


class State(IntEnum):
    """States of the controller (docs/architecture.md)."""

    STANDBY = 0
    CHECK = 1
    INFLATE = 2
    SETTLE = 3
    HOLD = 4
    MANUAL = 5
    TUNE = 6
    LOWER = 7
    FAULT = 8


class ShapeState(IntEnum):
    """States of the shape loop inside `hold`."""

    OFF = 0
    WAITING = 1
    TRACKING = 2
    SUSPENDED = 3


class SafeLevel(IntEnum):
    """The safe levels, by their names in telemetry; each times out into the next."""

    NONE = 0
    HOLD_FLOW = 1
    RAMP_DOWN = 2
    PUMP_OFF = 3
    VENT = 4


@dataclass(frozen=True, slots=True)
class TelemetryRow(ColumnValues):
    """What one tick read, decided and wrote: its columns, and its bytes."""

    def pack(self) -> bytes:
        """The row as doubles in field order."""
        return _STRUCT.pack(*_values(self))

    @classmethod
    def unpack(cls, message: bytes) -> "TelemetryRow":
        """Decode the row of `pack`. Raises struct.error."""
        return cls(*_STRUCT.unpack(message))


# By its name in tables, events, checksums and memories of earlier versions: a field.
TODAY: dict[str, str] = {"rung": "safe_level"}
FIELDS: tuple[str, ...] = tuple(COLUMNS)
_values = attrgetter(*FIELDS)  # astuple would copy deeply: 15 us per tick
_STRUCT = struct.Struct(f"<{len(FIELDS)}d")
ROW_BYTES = _STRUCT.size
# Of a row of earlier versions: the first one had no estimate, the second one no interlocks.
FIRST_BYTES = 8 * FIELDS.index("estimate_sigma_um")
SECOND_BYTES = 8 * FIELDS.index("interlocks_open")


# A mirror counts as settled this long after hold began and after each setpoint ramp: three closed-loop time constants
# of 1.45 s (docs/physics.md, inner loop) leave 5 % of a step, of which the `settle` state has already taken most.
SETTLED_AFTER_S = 5.0

Rows = FloatArray
COLUMN: dict[str, int] = {name: place for place, name in enumerate(FIELDS)}


def unpack(messages: Sequence[bytes]) -> Rows:
    """Packed `TelemetryRow`s as a table (n, len(FIELDS))."""
    return np.frombuffer(b"".join(messages), dtype="<f8").reshape(-1, len(FIELDS))


def column(rows: Rows, name: str) -> FloatArray:
    """One field of all rows, (n,)."""
    return rows[:, COLUMN[name]]


def columns(rows: Rows) -> dict[str, Column]:
    """All fields of rows by name, (n,) each."""
    return dict(zip(FIELDS, rows.T, strict=True))


def true_error_um(ticks: Mapping[str, Column]) -> Column:
    """Target minus true centre, with the sign of `error_um` (setpoint minus value); NaN on a real bench."""
    return ticks["target_um"] - ticks["truth_displacement_um"]


def changes(codes: FloatArray, before: float) -> list[tuple[int, int]]:
    """Changes of a code: (row, new code) for each, comparing the first row with `before` (NaN: none)."""
    previous = np.concatenate(([before], codes[:-1]))
    return [(int(row), int(codes[row])) for row in np.flatnonzero((codes != previous) & np.isfinite(codes))]


_GONE = "no recorder runs"
_LONGEST = 300  # characters of one failure in the status; the event has the full text


@dataclass(frozen=True, slots=True)
class RunStatus:
    """The newest tick, and the state that follows from all events so far."""

    row: TelemetryRow | None = None  # of the newest tick; None before the first one
    since_s: float = 0.0  # when the run entered its state
    why: str = ""  # the controller's last reason
    fault: events.Fault | None = None  # the standing fault
    last_fault: events.Fault | None = None  # the newest fault
    last_fault_s: float = math.nan  # its time
    faults: int = 0  # so far in the run
    shape_reason: str = ""  # of the shape loop
    acquisition: run_events.AcquisitionState | None = None  # the acquisition's last report
    geometry: run_events.GeometryInForce | None = None  # used by the cycles
    maintenance: Mapping[str, str] = field(default_factory=dict)  # active maintenance notices, by name
    interlocks: Mapping[str, str] = field(default_factory=dict)  # texts of the open ones, by name
    # failures of the recording, by subject. A full disk may prevent `events.jsonl` from reporting itself
    recording: Mapping[str, str] = field(default_factory=dict)
    loop: Mapping[str, Any] | None = None  # gains set during the run; None: those of the configuration
    kept_loop: Mapping[str, Any] | None = None  # what a trial goes back to
    locks: tuple[Lock, ...] = ()  # set by people, oldest first
    unstored: Mapping[str, str] = field(default_factory=dict)  # by a lock's word: why it is not on the disk
    latched: str = ""  # a fault of an earlier run that waits for `ack`
    trial_ends_s: float = math.nan  # when gains on trial are reverted; NaN: none are
    ended: bool = False

    @property
    def trial_left_s(self) -> float:
        """How long gains on trial may still be kept; NaN if none are."""
        return self.trial_ends_s - self.row.mono_s if self.row else math.nan

    @property
    def interlock_lines(self) -> tuple[str, ...]:
        """Each open interlock for people."""
        return tuple(f"interlock {name} is open: {text}" for name, text in self.interlocks.items())

    @property
    def recording_words(self) -> str:
        """All failures of the recording in one line; empty if there are none."""
        return "; ".join(self.recording.values())

    def after_row(self, row: TelemetryRow) -> "RunStatus":
        """The status after a tick."""
        same = self.row is not None and row.state == self.row.state
        return replace(self, row=row, since_s=self.since_s if same else row.mono_s)

    def after_event(self, event: events.Event, mono_s: float = math.nan) -> "RunStatus":
        """The status after an event; most change nothing."""
        match event:
            case events.Why():
                return replace(self, why=event.why)
            case events.StateEntered():
                return replace(self, why=event.why, fault=None if event.from_ == "fault" else self.fault)
            case events.Fault():
                return replace(self, fault=event, last_fault=event, last_fault_s=mono_s, faults=self.faults + 1)
            case events.Cleared():
                return replace(self, fault=None)
            case events.ShapeLoopState():
                return replace(self, shape_reason=event.reason)
            case events.CommandTaken(command="gains", refused=None, loop=dict() as told, value=trial_s):
                # the pump's curve stays when gains change
                loop: dict[str, Any] = {**(self.loop or {}), **told}
                kept = self.kept_loop if trial_s is not None else loop
                ends_s = math.nan if trial_s is None else mono_s + trial_s
                return replace(self, loop=loop, kept_loop=kept, trial_ends_s=ends_s)
            case events.CommandTaken(command="keep", refused=None):
                return replace(self, kept_loop=self.loop, trial_ends_s=math.nan)
            case events.CommandTaken(command="latched", text=text):
                return replace(self, latched=text or "")
            case events.CommandTaken(command="ack", refused=None):
                return replace(self, latched="")
            case events.LockSet():
                lock = Lock(event.word, event.text, event.author, event.account, event.session, event.set_utc)
                return replace(self, locks=(*self.locks, lock))
            case events.LockRemoved(word=word):
                kept_locks = tuple(lock for lock in self.locks if lock.word != word)
                return replace(self, locks=kept_locks, unstored=_without(self.unstored, word))
            case run_events.LockNotStored():
                return replace(self, unstored={**self.unstored, event.word: event.message})
            case run_events.LockStored():
                return replace(self, unstored=_without(self.unstored, event.word))
            case events.GainsReverted():
                return replace(self, loop=self.kept_loop, trial_ends_s=math.nan)
            case events.Maintenance():
                return replace(self, maintenance={**self.maintenance, event.name: event.message})
            case events.MaintenanceOver():
                return replace(self, maintenance=_without(self.maintenance, event.name))
            case events.InterlockOpened():
                return replace(self, interlocks={**self.interlocks, event.name: event.text})
            case events.InterlockClosed():
                return replace(self, interlocks=_without(self.interlocks, event.name))
            case run_events.GeometryInForce():
                return replace(self, geometry=event)
            case run_events.AcquisitionState():
                return replace(self, acquisition=event)
            case run_events.Ended():
                return replace(self, ended=True)
        return replace(self, recording=_recording(self.recording, event))


def gains_words(loop: Mapping[str, Any], trial_left_s: float | None) -> str:
    """Gains for a person, with the countdown of a trial."""
    on_trial = trial_left_s is not None and math.isfinite(trial_left_s)
    trial = f"; on trial, reverted in {max(trial_left_s or 0.0, 0.0):.0f} s unless kept" if on_trial else ""
    return f"Kp {loop['kp_per_s']:g} 1/s, Ti {loop['ti_s']:g} s, Td {loop['td_s']:g} s{trial}"


def _recording(standing: Mapping[str, str], event: events.Event) -> Mapping[str, str]:
    match event:
        case run_events.RecorderError() | run_events.DiskLow():
            return {**standing, event.what: " ".join(event.message.split())[:_LONGEST]}
        case run_events.RecorderRecovered():
            return _without(standing, event.what)
        case run_events.ChildEnded(child="recorder") | run_events.ChildGivenUp(child="recorder"):
            return {**standing, "recorder": _GONE}
        case run_events.ChildRestarted(child="recorder"):
            return {}  # the next recorder reports remaining failures
    return standing


def _without(standing: Mapping[str, str], name: str) -> Mapping[str, str]:
    return {key: words for key, words in standing.items() if key != name}
