"""`summary.json`: the figures of a run, computed on the fly in constant memory."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import (
    acquisition_events,
    event_lines,
    events,
    program,
    run_events,
    shape_estimate,
    telemetry,
)
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.model.standing_fault import fault_of_end, standing_fault_after
from membrane_ctrl.model.state_tree import Count, StateNode
from membrane_ctrl.run_files.held_error import HeldErrorMeter
from membrane_ctrl.run_files.run_statistics import LogHistogram, Moments

SCHEMA = "membrane-summary/2"

# Limits on listed transitions and faults; their counters continue (a device may flicker for a
# week).
_LISTED_MAX = 1000


@dataclass(frozen=True, slots=True)
class EnteredState(StateNode):
    """A state of the controller, and when it was entered."""

    state: str
    mono_s: float


@dataclass(slots=True)
class Summary(StateNode):
    """Accumulates all that is recorded; `as_dict` gives `summary.json` at any time.

    "True" is the target minus the true centre of the twin's mirror: on a real bench those
    keys are null.
    """

    held: HeldErrorMeter
    true_um: Moments = field(default_factory=Moments)
    reading_um: Moments = field(default_factory=Moments)
    lateness_ms: LogHistogram = field(default_factory=LogHistogram)
    latency_ms: LogHistogram = field(default_factory=LogHistogram)
    rows: Count = 0
    missed_ticks: Count = 0
    cycles: Count = 0
    rejected: Count = 0
    first_cycle_s: float = math.nan
    last_cycle_s: float = math.nan
    leak_um_per_s: float = math.nan
    state: float = math.nan
    time_s: float = 0.0
    states: list[EnteredState] = field(default_factory=list)
    transitions: Count = 0
    faults: list[EventLine] = field(default_factory=list)
    standing_fault: EventLine | None = None
    fault_count: Count = 0
    geometry: EventLine = field(default_factory=dict)
    end: EventLine = field(default_factory=dict)

    @classmethod
    def for_config(cls, config: Config) -> "Summary":
        """Return the empty summary of a run with this configuration."""
        return cls(HeldErrorMeter.for_config(config))

    def add_rows(self, rows: telemetry.Rows) -> None:
        """Add (n, len(FIELDS)) telemetry rows, in order."""
        if not len(rows):
            return
        # States entered
        time_s = telemetry.get_column(rows, "mono_s")
        state = telemetry.get_column(rows, "state")
        for row, code in telemetry.find_changes(state, self.state):
            self.transitions += 1
            if len(self.states) < _LISTED_MAX:
                name = telemetry.State(code).name.lower()
                self.states.append(EnteredState(name, float(time_s[row])))
        self.state = float(state[-1])
        # Errors of the rows in which the mirror is held
        is_held = self.held.add_rows(rows)
        settled = telemetry.get_columns(rows[is_held])
        self.true_um.add(telemetry.true_error_um(settled))
        self.reading_um.add(settled["setpoint_um"] - settled["displacement_um"])
        # All rows
        self.lateness_ms.add(telemetry.get_column(rows, "lateness_ms"))
        self.rows += len(rows)
        self.missed_ticks = int(telemetry.get_column(rows, "missed_ticks")[-1])
        self.time_s = max(self.time_s, float(time_s[-1]))
        leak = telemetry.get_column(rows, "leak_um_per_s")
        leak = leak[np.isfinite(leak)]
        if leak.size:
            self.leak_um_per_s = float(leak[-1])

    def add_event(self, line: EventLine) -> None:
        """Add one event; only those of faults and states, the geometry and the end of the run
        matter.
        """
        event = event_lines.from_dict(line)
        standing = standing_fault_after(self._read_standing_fault(), event)
        self.standing_fault = None if standing is None else standing.to_dict()
        match event:
            case events.Fault():
                self.fault_count += 1
                if len(self.faults) < _LISTED_MAX:
                    self.faults.append(line)
            case acquisition_events.GeometryInUse():
                self.geometry = {key: line.get(key) for key in ("hash", "file", "calibrated_utc")}
            case run_events.Ended():
                self.end = line

    def _read_standing_fault(self) -> events.Fault | None:
        if self.standing_fault is None:
            return None
        event = event_lines.from_dict(self.standing_fault)
        if isinstance(event, events.Fault):
            return event
        return None

    def add_shape(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Add the result of a measurement cycle."""
        self.cycles += 1
        if math.isnan(self.first_cycle_s):
            self.first_cycle_s = estimate.time_s
        self.last_cycle_s = estimate.time_s
        self.rejected += estimate.verdict == "rejected"
        self.latency_ms.add(np.array([estimate.latency_s * 1e3]))

    def _find_cycle_rate(self) -> float:
        """Figures per second between the first and the last; NaN without two."""
        lasted_s = self.last_cycle_s - self.first_cycle_s
        return (self.cycles - 1) / lasted_s if lasted_s > 0.0 else math.nan

    def as_dict(self, dropped: dict[str, int], recorder: dict[str, Any]) -> dict[str, Any]:
        """The content of `summary.json`; NaN for missing figures.

        Parameters
        ----------
        dropped : dict
            Messages overwritten before the recorder read them, by ring ("telemetry", ...).
        recorder : dict
            The recorder's own data: files, errors.
        """
        true, means = self.true_um, self.held.true_1s_um.result()
        held = means if means["seconds"] else self.held.reading_1s_um.result()
        fault = fault_of_end(self._read_standing_fault(), self.end.get("exit"))
        return {
            **program.file_origin(SCHEMA),
            "exit": self.end.get("exit"),
            "duration_s": max(self.time_s, float(self.end.get("mono_s") or 0.0)),
            "true_std_um": true.std,
            "true_bias_um": true.mean if true.count else math.nan,
            "in_band_1s_fraction": means["in_band"],
            "band_1s_windows": means["seconds"],
            "settled_after_s": telemetry.SETTLED_AFTER_S,
            "sag_error_um": {"start": means["first_um"], "end": means["last_um"]},
            "held": {"of": self.held.result().of}
            | held
            | {f"{name}_s": time_s for name, time_s in self.held.parts_s.items()},
            "reading_std_um": self.reading_um.std,
            "leak_um_per_s": self.leak_um_per_s,
            "lateness_ms": _histogram_quantiles(self.lateness_ms)
            | {"max": self.lateness_ms.largest},
            "ticks": self.rows + dropped.get("inputs", 0),
            "missed_ticks": self.missed_ticks,
            "cycles": self.cycles,
            "cycles_rejected": self.rejected,
            "cycles_per_s": self._find_cycle_rate(),
            "cycle_latency_ms": _histogram_quantiles(self.latency_ms),
            "geometry": self.geometry,
            "states": [asdict(each) for each in self.states],
            "transitions": self.transitions,
            "faults": self.faults,
            "fault_count": self.fault_count,
            "ended_in": None if fault is None else fault.to_dict(),
            "dropped": dropped,
            "recorder": recorder,
            "end": self.end,
        }


def _histogram_quantiles(histogram: LogHistogram) -> dict[str, float]:
    return {"p50": histogram.find_quantile(0.50), "p99": histogram.find_quantile(0.99)}
