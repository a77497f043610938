"""What the files of a run state about its end, after its hold has gone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from enum import Enum, auto
from pathlib import Path

from membrane_ctrl.model import errors, events, run_events
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.event_base import Event
from membrane_ctrl.model.standing_fault import fault_of_end, standing_fault_after
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.run_files import table_specs
from membrane_ctrl.run_files.event_log import LoggedEvent
from membrane_ctrl.run_files.run import Run, open_run
from membrane_ctrl.run_files.run_lookup import is_run_name
from membrane_ctrl.run_files.table_store.reader import TableReader
from membrane_ctrl.service.event_lines import SHOWN_MOST, format_event

REPORT_NAME = "report/report.html"  # in a run's folder, as `report` writes it
_LAST_TICKS_S = 1.0
_STOP_BEFORE_END_S = 120.0  # a stop that is older ended nothing: the run went on
_READ_BACK = ("pump_readback_fraction", "vent_readback_fraction", "state")
_LOOK_AT_BENCH = (
    "look whether the pump runs (a board's watchdog stops its pump); then read the end of the "
    "hold's log, and start again"
)


class EndKind(Enum):
    """How a run ended."""

    NO_RECORD = auto()  # the files hold no end
    CONTROL_GONE = auto()  # the recorder has seen that the control process had gone
    FAULT = auto()
    DEVICE = auto()
    STOPPED = auto()  # by a person or a signal
    FINISHED = auto()  # its duration was over
    NEVER_HELD = auto()  # its duration was over before it held


@dataclass(frozen=True, slots=True)
class EndedRun:
    """A run whose hold has gone.

    Attributes
    ----------
    folder : Path
    kind : EndKind
    ended_utc : datetime
        Of the end, or of the last record.
    state : str
        State of the last tick; empty if there is none.
    fault : Fault or None
        In which it ended.
    fault_utc : datetime or None
        When that fault tripped.
    stopped_by, stop_reason : str
        Who sent the last `stop`, and why; empty if nobody did.
    pump_fraction, vent_fraction : float
        As the device reported them last; NaN if it did not.
    read_utc : datetime or None
        When it reported them.
    events : tuple of str
        The last events, oldest first.
    """

    folder: Path
    kind: EndKind
    ended_utc: datetime
    state: str = ""
    fault: events.Fault | None = None
    fault_utc: datetime | None = None
    stopped_by: str = ""
    stop_reason: str = ""
    pump_fraction: float = math.nan
    vent_fraction: float = math.nan
    read_utc: datetime | None = None
    events: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.folder.name

    @property
    def is_regular(self) -> bool:
        """Whether a person or the run's duration ended it."""
        return self.kind in (EndKind.STOPPED, EndKind.FINISHED)

    @property
    def cause(self) -> str:
        """Why it ended, and who ended it."""
        match self.kind:
            case EndKind.FAULT:
                assert self.fault is not None
                return f"fault {self.fault.code} {self.fault.name}: {self.fault.cause}"
            case EndKind.DEVICE:
                return "a device failed; the events name it"
            case EndKind.STOPPED:
                reason = f" ({self.stop_reason})" if self.stop_reason else ""
                return f"stopped by {self.stopped_by}{reason}"
            case EndKind.FINISHED:
                return "its duration was over"
            case EndKind.NEVER_HELD:
                return "its duration was over before it held"
            case EndKind.CONTROL_GONE:
                return (
                    "the control process ended without a report; cause unknown: it looks like "
                    "a kill, a crash or too little memory"
                )
            case EndKind.NO_RECORD:
                return (
                    "no end is recorded; cause unknown: it looks like a power cut, or control "
                    "process and recorder were killed"
                )

    @property
    def remedy(self) -> str:
        """What to do."""
        if self.kind is EndKind.FAULT:
            assert self.fault is not None
            return self.fault.remedy
        if self.kind is EndKind.DEVICE:
            return "look whether the pump runs; find out why the link failed"
        if self.kind in (EndKind.CONTROL_GONE, EndKind.NO_RECORD):
            return _LOOK_AT_BENCH
        if self.kind is EndKind.NEVER_HELD:
            return "give the hold more time; the events state what it waited for"
        return "nothing; start a hold when you want one"

    @property
    def headline(self) -> str:
        """When and why it ended, in one line."""
        return f"run ended {self.ended_utc:%Y-%m-%d %H:%M:%S} UTC: {self.cause}"

    def lines(self) -> tuple[str, ...]:
        """All that people need, a line each; the headline first."""
        lines = [self.headline]
        if self.fault is not None and self.fault_utc is not None:
            limit = f" (limit: {self.fault.limit})" if self.fault.limit else ""
            lines.append(f"seen {self.fault_utc:%H:%M:%S} UTC: {self.fault.seen}{limit}")
        lines.append(f"to do: {self.remedy}")
        if self.read_utc is not None:
            pump = _format_percent(self.pump_fraction)
            vent = _format_percent(self.vent_fraction)
            lines.append(
                f"as last read back at {self.read_utc:%H:%M:%S} UTC: pump {pump}, vent {vent}, "
                f"state {self.state}"
            )
        return tuple(lines)


def _format_percent(fraction: float) -> str:
    return f"{100 * fraction:.0f} %" if math.isfinite(fraction) else "not reported"


def read_ended_run(folder: Path) -> EndedRun:
    """Read how a run ended.

    Parameters
    ----------
    folder : Path
        Folder of the run.

    Returns
    -------
    EndedRun

    Raises
    ------
    InputError, OSError, ValueError
        The folder is no run, or cannot be read.
    """
    run = open_run(folder)
    end = _find_end(run.log)
    # Without an end, the last event is the last that is known of the control process
    end_s = 0.0
    if end is not None:
        end_s = end.mono_s
    elif run.log:
        end_s = run.log[-1].mono_s
    read_s, pump, vent, state = _read_last_tick(run)
    exit_word = _exit_of(end)
    fault, fault_s = _find_fault(run.log, exit_word)
    stop = _find_stop(run.log, end_s)
    last_s = max(end_s, read_s) if math.isfinite(read_s) else end_s
    return EndedRun(
        folder=folder,
        kind=_judge_end(exit_word, fault, stop),
        ended_utc=run.utc(end_s if end is not None else last_s),
        state=state,
        fault=fault,
        fault_utc=None if fault is None else run.utc(fault_s),
        stopped_by="" if stop is None else stop.who,
        stop_reason="" if stop is None else stop.why,
        pump_fraction=pump,
        vent_fraction=vent,
        read_utc=run.utc(read_s) if math.isfinite(read_s) else None,
        events=tuple(
            format_event(run.utc(each.mono_s), each.event) for each in run.log[-SHOWN_MOST:]
        ),
    )


def find_newest_run(logs: Path) -> Path | None:
    """Return the newest folder of a run in a folder of runs, by its name; None without one."""
    with suppress(OSError):
        for folder in sorted(logs.iterdir(), reverse=True):
            if is_run_name(folder.name) and (folder / "events.jsonl").exists():
                return folder
    return None


def _judge_end(
    exit_word: str | None, fault: events.Fault | None, stop: events.CommandTaken | None
) -> EndKind:
    """Which kind of end it is, by the exit, the fault that stood then, and a stop shortly
    before.
    """
    # From no record to a regular end. A fault is judged before the exit that it causes.
    if exit_word is None:
        return EndKind.NO_RECORD
    if exit_word in run_events.ENDS_WITHOUT_CONTROL:
        return EndKind.CONTROL_GONE
    if fault is not None:
        return EndKind.FAULT
    if exit_word in (Exit.DEVICE_FAILED.name.lower(), Exit.SAFETY_TRIP.name.lower()):
        return EndKind.DEVICE
    if exit_word == Exit.REJECTED.name.lower():
        return EndKind.NEVER_HELD
    return EndKind.FINISHED if stop is None else EndKind.STOPPED


def _find_end(log: Sequence[LoggedEvent]) -> LoggedEvent | None:
    """Return the end that the control process has reported, else the last one."""
    ends = [each for each in log if isinstance(each.event, run_events.Ended)]
    reported = [each for each in ends if not _is_without_control(each.event)]
    return next(reversed([*ends[-1:], *reported[-1:]]), None)


def _is_without_control(event: Event) -> bool:
    return isinstance(event, run_events.Ended) and event.exit in run_events.ENDS_WITHOUT_CONTROL


def _exit_of(end: LoggedEvent | None) -> str | None:
    """Return how an `end` calls it; None without one."""
    if end is None or not isinstance(end.event, run_events.Ended):
        return None
    return end.event.exit


def _find_fault(
    log: Sequence[LoggedEvent], exit_word: str | None
) -> tuple[events.Fault | None, float]:
    """Return the fault in which the run ended and its time; NaN without one."""
    standing: events.Fault | None = None
    fault_s = math.nan
    for each in log:
        if isinstance(each.event, events.Fault):
            fault_s = each.mono_s
        standing = standing_fault_after(standing, each.event)
    return fault_of_end(standing, exit_word), fault_s


def _find_stop(log: Sequence[LoggedEvent], end_s: float) -> events.CommandTaken | None:
    """Return the last accepted `stop` shortly before the end; None without one."""
    for each in reversed(log):
        if end_s - each.mono_s > _STOP_BEFORE_END_S:
            return None
        event = each.event
        if isinstance(event, events.CommandTaken) and event.command == "stop" and not event.refused:
            return event
    return None


def _read_last_tick(run: Run) -> tuple[float, float, float, str]:
    """Return time, pump, vent and state of the last tick; NaN and an empty state without one."""
    with suppress(OSError, ValueError, errors.CommandError):
        newest = TableReader(run.folder, table_specs.TICKS, []).read_newest("mono_s")
        names = ("mono_s", *_READ_BACK)
        begin_s = math.inf if newest is None else float(newest.as_py()) - _LAST_TICKS_S
        blocks = [block for block in run.tick_blocks(names, begin_s) if block["mono_s"].size]
        if blocks:
            time_s, pump, vent, code = (float(blocks[-1][name][-1]) for name in names)
            state = State(int(code)).name.lower() if math.isfinite(code) else ""
            return time_s, pump, vent, state
    return math.nan, math.nan, math.nan, ""
