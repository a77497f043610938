"""Turns telemetry rows, events and shapes into the console's content. No I/O, no terminal, no
clock.
"""

import math
from collections import deque
from dataclasses import asdict, dataclass
from statistics import fmean, pstdev

from membrane_ctrl.config.schema import Config
from membrane_ctrl.console.why import (
    explain_next_step,
    explain_state,
    format_duration,
    format_number,
)
from membrane_ctrl.control.leak_estimate import JUDGE_S, TOO_TIGHT_UM_PER_S
from membrane_ctrl.model import (
    acquisition_events,
    child_events,
    event_lines,
    events,
    run_status,
    shape_estimate,
    telemetry,
)
from membrane_ctrl.model.held_words import describe_held
from membrane_ctrl.model.lock import describe_lock
from membrane_ctrl.run_files.held_error import HeldError, HeldErrorMeter

MINUTE_S = 60
TREND_S = 240  # the widest terminal shows this much
_EVENTS_KEPT = 60
_NOT_LISTED = events.Why | child_events.Alive  # the headline shows the first
SILENT_S = 1.0  # the control process hangs if no row comes for this long


class Trend:
    """The last minutes of a signal, by whole seconds of the run's clock."""

    def __init__(self) -> None:
        self._seconds: deque[tuple[int, list[float]]] = deque(maxlen=TREND_S)

    def add(self, mono_s: float, value: float) -> None:
        """Add a value to the mean of its second.

        Parameters
        ----------
        mono_s : float
            Time by the run's clock; must not fall.
        value : float
            NaN is left out: a second with nothing else is a gap.
        """
        second = math.floor(mono_s)
        if not self._seconds or self._seconds[-1][0] != second:
            self._seconds.append((second, []))
        if math.isfinite(value):
            self._seconds[-1][1].append(value)

    def mean_by_seconds(self) -> tuple[float, ...]:
        """Mean of each of the last `TREND_S` seconds, oldest first; NaN for a gap."""
        if not self._seconds:
            return (math.nan,) * TREND_S
        newest = self._seconds[-1][0]
        known = {
            second: math.fsum(values) / len(values) for second, values in self._seconds if values
        }
        return tuple(
            known.get(second, math.nan) for second in range(newest - TREND_S + 1, newest + 1)
        )

    def finite_values(self) -> list[float]:
        """Every finite value of the last minute, oldest first."""
        if not self._seconds:
            return []
        oldest = self._seconds[-1][0] - MINUTE_S + 1
        return [value for second, values in self._seconds if second >= oldest for value in values]


@dataclass(frozen=True, slots=True)
class ShapeView:
    """The last measurement cycle and the shape loop; `note` names any problem."""

    state: telemetry.ShapeState
    estimate: shape_estimate.ShapeEstimate | None
    age_s: float
    sag_change_um: float  # since the reference: the first usable estimate of a settled hold
    change_sigma_um: float  # of that change, noise only
    reference_s: float  # when the reference was taken
    cycles: int
    rejected: int
    note: str


@dataclass(frozen=True, slots=True)
class ConsoleView:
    """Content of the console, still as numbers."""

    row: telemetry.TelemetryRow | None  # the newest tick; None before the first
    why: str  # the answer in one line
    locks: tuple[str, ...]  # each lock in words
    next_step: str  # how to continue, if that takes a person
    paused: bool
    silent_s: float  # age of the row if it deserves a warning, else 0
    state: telemetry.State
    state_age_s: float
    elapsed_s: float
    left_s: float  # from the first tick; infinite for a run without an end
    trend_um: tuple[float, ...]  # mean error of each of the last `TREND_S` seconds
    held: HeldError  # of the run until now
    error_std_um: float  # of the last minute's error samples, as the next
    in_band_fraction: float
    lateness_max_ms: float  # the worst of the last minute
    fault: str  # the standing fault
    remedy: str  # for it
    faults: int  # faults so far in the run
    last_fault: str  # the newest of them, with its time
    held_scalar: str  # what is held besides the centre; empty for the centre
    too_tight: bool  # the leak is too small for the band
    gains: str  # in use, with the countdown of a trial
    flow_most_um_per_s: float  # with the present curve
    notices: tuple[str, ...]  # a sentence each; neither of faults nor of locks
    events: tuple[events.EventLine, ...]  # the last ones, oldest first
    shape: ShapeView


class ConsoleModel:
    """Remembers the rows, events and shapes that the console shows.

    `ctl` is the beginning of a command for this run, as a person types it; `keys`: the console has
    keys.
    """

    def __init__(
        self,
        config: Config,
        duration_s: float | None = None,
        ctl: str = "membrane-ctrl ctl",
        keys: bool = False,
    ) -> None:
        self._ctl = ctl
        self._keys = keys
        self._config = config
        self._duration_s = math.inf if duration_s is None else duration_s
        self._status = run_status.RunStatus()
        self._started_s = math.nan
        self._error = Trend()
        self._lateness = Trend()
        self._held = HeldErrorMeter.for_config(config)
        self._estimate: shape_estimate.ShapeEstimate | None = None
        self._reference: shape_estimate.ShapeEstimate | None = None
        self._cycles = 0
        self._rejected = 0
        self._events: deque[events.EventLine] = deque(maxlen=_EVENTS_KEPT)

    @property
    def has_ended(self) -> bool:
        """The "end" event has arrived."""
        return self._status.ended

    def add_row(self, row: telemetry.TelemetryRow) -> None:
        """Take one tick."""
        if self._status.row is None:
            self._started_s = row.mono_s
        self._status = self._status.after_row(row)
        self._error.add(row.mono_s, row.error_um)
        self._lateness.add(row.mono_s, row.lateness_ms)

    def add_rows(self, rows: telemetry.Rows) -> None:
        """Add (n, len(FIELDS)) ticks to the figures of the whole run."""
        if len(rows):
            self._held.add_rows(rows)

    def add_event(self, line: events.EventLine) -> None:
        """Take one event, a line of `events.jsonl`."""
        event = event_lines.from_dict(line)
        self._status = self._status.after_event(event, line.get("mono_s", math.nan))
        if not isinstance(event, _NOT_LISTED):
            self._events.append(line)

    def add_shape(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Take one measurement cycle."""
        # The reference is the first usable figure after the mirror has settled in this hold
        self._estimate, row = estimate, self._status.row
        self._cycles += 1
        if estimate.verdict == "rejected":
            self._rejected += 1
        elif row is not None and row.state == telemetry.State.HOLD:
            settled_s = self._status.since_s + telemetry.SETTLED_AFTER_S
            if estimate.time_s >= settled_s and (
                self._reference is None or self._reference.time_s < settled_s
            ):
                self._reference = estimate

    def make_view(self, now_s: float) -> ConsoleView:
        """The content at a time of the run's clock."""
        # State and next step, once there is a tick.
        status, row = self._status, self._status.row
        state = telemetry.State.STANDBY
        next_step = ""
        age_s = 0.0
        held_s = 0.0
        if row is not None:
            state = telemetry.State(int(row.state))
            next_step = explain_next_step(
                row, status.paused, self._ctl, self._keys, status.locks, status.latched
            )
            age_s = now_s - row.mono_s
            held_s = now_s - self._started_s
        # Figures of the last minute's error.
        errors_um = self._error.finite_values()
        std_um = in_band = math.nan
        if errors_um:
            std_um = pstdev(errors_um)
            in_band = fmean(abs(error) <= self._config.limits.band_um for error in errors_um)
        present = self._config.with_gains(status.loop)
        return ConsoleView(
            row=row,
            why=self._explain_state(),
            locks=tuple(map(describe_lock, status.locks)),
            next_step=next_step,
            paused=status.paused,
            silent_s=age_s if age_s > SILENT_S else 0.0,
            state=state,
            state_age_s=max(0.0, now_s - status.since_s),
            elapsed_s=now_s,
            left_s=max(0.0, self._duration_s - held_s),
            trend_um=self._error.mean_by_seconds(),
            held=self._held.result(),
            error_std_um=std_um,
            in_band_fraction=in_band,
            lateness_max_ms=max(self._lateness.finite_values(), default=math.nan),
            fault=describe_fault_state(status.fault),
            remedy=status.fault.remedy if status.fault else "",
            faults=status.faults,
            last_fault=self._describe_last_fault(),
            held_scalar=self._describe_held_scalar(),
            too_tight=self._too_tight(now_s),
            gains=run_status.gains_words(vars(present.loop), status.trial_left_s),
            flow_most_um_per_s=present.loop.flow_most_um_per_s(present.pump),
            notices=tuple(notice.short_text for notice in status.other_notices),
            events=tuple(self._events),
            shape=self._make_shape_view(now_s),
        )

    def _describe_last_fault(self) -> str:
        status = self._status
        if not status.faults:
            return ""
        time = format_duration(status.last_fault_s)
        return f"{describe_fault_state(status.last_fault)} at {time}"

    def _describe_held_scalar(self) -> str:
        status = self._status
        if status.held is None or status.row is None:
            return ""
        return describe_held(asdict(status.held), asdict(status.row))

    def _too_tight(self, now_s: float) -> bool:
        row = self._status.row
        judged = (
            row is not None
            and row.state == telemetry.State.HOLD
            and now_s - self._status.since_s >= JUDGE_S
        )
        return row is not None and judged and row.leak_um_per_s < TOO_TIGHT_UM_PER_S

    def _explain_state(self) -> str:
        status = self._status
        if status.row is None:
            return status.why or "starting: no tick yet"
        return explain_state(
            status.row, status.why, describe_fault_state(status.fault), self._config, status.paused
        )

    def _make_shape_view(self, now_s: float) -> ShapeView:
        """The figure's part of the view; NaN for what is not known yet."""
        estimate = self._estimate
        reference = self._reference
        status = self._status
        state = telemetry.ShapeState.OFF
        if status.row is not None:
            state = telemetry.ShapeState(int(status.row.shape_state))
        age_s = change_um = sigma_um = reference_s = math.nan
        doubt = ""  # about the figure
        if estimate is not None:
            age_s = now_s - estimate.time_s
            doubt = estimate.reason if estimate.verdict != "ok" else ""
        if reference is not None:
            reference_s = reference.time_s
        if estimate is not None and reference is not None:
            change_um = estimate.sag_um - reference.sag_um
            sigma_um = math.hypot(estimate.sag_change_sigma_um, reference.sag_change_sigma_um)
        waits = state in (telemetry.ShapeState.WAITING, telemetry.ShapeState.SUSPENDED)
        loop = status.shape_reason if waits else ""
        return ShapeView(
            state=state,
            estimate=estimate,
            age_s=age_s,
            sag_change_um=change_um,
            change_sigma_um=sigma_um,
            reference_s=reference_s,
            cycles=self._cycles,
            rejected=self._rejected,
            note=_describe_acquisition(status.acquisition) or loop or doubt,
        )


def _describe_acquisition(reported: acquisition_events.AcquisitionState | None) -> str:
    if reported is None or reported.state == "running":
        return ""
    return ": ".join(words for words in (reported.state, reported.message) if words)


def describe_fault_state(fault: events.Fault | None) -> str:
    """Name, cause and observed value of a fault; empty without one."""
    if fault is None:
        return ""
    cause = ": ".join(words for words in (fault.name.replace("_", " "), fault.cause) if words)
    return f"{cause or 'unnamed'}{f' ({fault.seen})' if fault.seen else ''}"


def event_line(line: events.EventLine) -> str:
    """Format an event as one line of a log."""
    time_s = format_number(line.get("mono_s", math.nan), 1)
    return f"{time_s:>9} s  {event_lines.from_dict(line).sentence}"
