"""From telemetry rows, events and shapes to what the console shows. No I/O, no terminal, no clock."""

import math
from collections import deque
from dataclasses import dataclass
from statistics import fmean, pstdev
from typing import Any

from membrane_ctrl.config.schema import Config
from membrane_ctrl.console.why import duration, why
from membrane_ctrl.control.film_health import JUDGE_S, TOO_TIGHT_UM_PER_S
from membrane_ctrl.control_port.status import RecorderTrouble
from membrane_ctrl.model import shape_estimate, states, telemetry

# The last minute of a signal, second by second.


MINUTE_S = 60


class Trend:
    """Means over whole seconds of the run's clock, for the last minute."""

    def __init__(self) -> None:
        self._seconds: deque[tuple[int, list[float]]] = deque(maxlen=MINUTE_S)

    def add(self, mono_s: float, value: float) -> None:
        """Take one value; NaN leaves a gap."""
        second = math.floor(mono_s)
        if not self._seconds or self._seconds[-1][0] != second:
            self._seconds.append((second, []))
        if math.isfinite(value):
            self._seconds[-1][1].append(value)

    def means(self) -> tuple[float, ...]:
        """Mean of each of the last 60 s, oldest first; NaN where there is none."""
        if not self._seconds:
            return (math.nan,) * MINUTE_S
        newest = self._seconds[-1][0]
        known = {second: math.fsum(values) / len(values) for second, values in self._seconds if values}
        return tuple(known.get(second, math.nan) for second in range(newest - MINUTE_S + 1, newest + 1))

    def values(self) -> list[float]:
        """Every finite value of the last minute, oldest first."""
        if not self._seconds:
            return []
        oldest = self._seconds[-1][0] - MINUTE_S + 1
        return [value for second, values in self._seconds if second >= oldest for value in values]


# The tick runs at 50 Hz, the console at 5: a row this old means that the control process stands still.
SILENT_S = 1.0

Event = dict[str, Any]


@dataclass(frozen=True, slots=True)
class ShapeView:
    """The last measurement cycle, and the loop that follows it.

    `sag_change_um` is against the first usable estimate of the hold; `note` says what is not as it should be.
    """

    state: states.ShapeState
    estimate: shape_estimate.ShapeEstimate | None
    age_s: float
    sag_change_um: float
    trim_um: float
    cycles: int
    rejected: int
    note: str


@dataclass(frozen=True, slots=True)
class ConsoleView:
    """Everything on the console, still as numbers.

    Attributes
    ----------
    row : TelemetryRow or None
        The newest tick; None before the first.
    why : str
        The one line.
    silent_s : float
        Age of the row if that is worth a warning, else 0.
    state_age_s, elapsed_s, left_s : float
        Times; `left_s` counts from the first tick and is infinite for a run without an end.
    trend_um : tuple of 60 float
        Mean error of each of the last 60 s.
    error_mean_um, error_std_um, in_band_fraction : float
        Of the error's samples in the last minute.
    lateness_max_ms : float
        The worst of the last minute.
    fault, remedy : str
        The fault that stands, and what to do about it.
    faults : int
        Faults so far in the run.
    last_fault : str
        The newest of them, with its time.
    too_tight : bool
        The leak is too small for the band.
    recording : str
        What keeps the run from being recorded; empty if nothing does.
    """

    row: telemetry.TelemetryRow | None
    why: str
    silent_s: float
    state: states.State
    state_age_s: float
    elapsed_s: float
    left_s: float
    trend_um: tuple[float, ...]
    error_mean_um: float
    error_std_um: float
    in_band_fraction: float
    lateness_max_ms: float
    fault: str
    remedy: str
    faults: int
    last_fault: str
    too_tight: bool
    recording: str
    shape: ShapeView


class ConsoleModel:
    """Takes what arrives and remembers what the console needs of it.

    Attributes
    ----------
    ended : bool
        The event that ends a run has been seen.
    """

    def __init__(self, config: Config, duration_s: float | None = None) -> None:
        self._config = config
        self._duration_s = math.inf if duration_s is None else duration_s
        self._row: telemetry.TelemetryRow | None = None
        self._started_s = math.nan
        self._since_s = 0.0
        self._told = ""
        self._fault = ""
        self._remedy = ""
        self._faults = 0
        self._last_fault = ""
        self._error = Trend()
        self._lateness = Trend()
        self._estimate: shape_estimate.ShapeEstimate | None = None
        self._first_sag_um = math.nan
        self._cycles = 0
        self._rejected = 0
        self._acquisition = ""
        self._shape_told = ""
        self._recorder = RecorderTrouble()
        self.ended = False

    def take_row(self, row: telemetry.TelemetryRow) -> None:
        """One tick."""
        if self._row is None:
            self._started_s = row.mono_s
        if self._row is None or row.state != self._row.state:
            self._since_s = row.mono_s
        self._row = row
        self._error.add(row.mono_s, row.error_um)
        self._lateness.add(row.mono_s, row.lateness_ms)

    def take_event(self, event: Event) -> None:
        """One event, a line of `events.jsonl`."""
        words = text(event)
        self._recorder.take(event)
        match event.get("kind"):
            case "state" | "why":
                self._told = words
            case "fault":
                self._faults += 1
                self._fault = words or "unnamed"
                self._remedy = event.get("remedy", "")
                self._last_fault = f"{self._fault} at {duration(event.get('mono_s', math.nan))}"
            case "cleared":
                self._fault = self._remedy = ""
            case "shape":
                self._shape_told = words
            case "acquisition":
                state = event.get("state", "")
                self._acquisition = "" if state == "running" else ": ".join(w for w in (state, words) if w)
            case "end":
                self.ended = True

    def take_shape(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """One measurement cycle."""
        self._estimate = estimate
        self._cycles += 1
        if estimate.verdict == "rejected":
            self._rejected += 1
        elif math.isnan(self._first_sag_um) and self._row is not None and self._row.state == states.State.HOLD:
            self._first_sag_um = estimate.sag_um

    def view(self, now_s: float) -> ConsoleView:
        """What to show at a moment of the run's clock."""
        row = self._row
        errors = self._error.values()
        band_um = self._config.limits.band_um
        age_s = now_s - row.mono_s if row else 0.0
        return ConsoleView(
            row=row,
            why=self._why(),
            silent_s=age_s if age_s > SILENT_S else 0.0,
            state=states.State(int(row.state)) if row else states.State.STANDBY,
            state_age_s=max(0.0, now_s - self._since_s),
            elapsed_s=now_s,
            left_s=max(0.0, self._duration_s - (now_s - self._started_s if row else 0.0)),
            trend_um=self._error.means(),
            error_mean_um=fmean(errors) if errors else math.nan,
            error_std_um=pstdev(errors) if errors else math.nan,
            in_band_fraction=fmean(abs(e) <= band_um for e in errors) if errors else math.nan,
            lateness_max_ms=max(self._lateness.values(), default=math.nan),
            fault=self._fault,
            remedy=self._remedy,
            faults=self._faults,
            last_fault=self._last_fault,
            too_tight=self._too_tight(now_s),
            recording=self._recorder.words,
            shape=self._shape(now_s),
        )

    def _too_tight(self, now_s: float) -> bool:
        row = self._row
        judged = row is not None and row.state == states.State.HOLD and now_s - self._since_s >= JUDGE_S
        return row is not None and judged and row.leak_um_per_s < TOO_TIGHT_UM_PER_S

    def _why(self) -> str:
        if self._row is None:
            return self._told or "starting: the control loop has not ticked yet"
        return why(self._row, self._told, self._fault, self._config)

    def _shape(self, now_s: float) -> ShapeView:
        estimate, row = self._estimate, self._row
        state = states.ShapeState(int(row.shape_state)) if row else states.ShapeState.OFF
        reason = estimate.reason if estimate and estimate.verdict != "ok" else ""
        loop = self._shape_told if state in (states.ShapeState.WAITING, states.ShapeState.SUSPENDED) else ""
        return ShapeView(
            state=state,
            estimate=estimate,
            age_s=now_s - estimate.time_s if estimate else math.nan,
            sag_change_um=estimate.sag_um - self._first_sag_um if estimate else math.nan,
            trim_um=row.trim_um if row else math.nan,
            cycles=self._cycles,
            rejected=self._rejected,
            note=self._acquisition or loop or reason,
        )


def text(event: Event) -> str:
    """The words of an event for a person: its name if it has one, its reason, and what was seen."""
    name = str(event.get("name", "")).replace("_", " ")
    reason = next((str(event[key]) for key in ("why", "reason", "cause", "message") if event.get(key)), "")
    seen = f" ({event['seen']})" if event.get("seen") else ""
    return ": ".join(words for words in (name, reason) if words) + seen
