"""`summary.json`: the figures of a run, computed on the fly in constant memory."""

import math
from typing import Any

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import events, program, run_events, shape_estimate, telemetry
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.model.standing_fault import fault_of_end, standing_fault_after
from membrane_ctrl.run_files.hold_parts import PARTS, HoldParts
from membrane_ctrl.run_files.run_statistics import LogHistogram, Moments, SecondMeans, least_ticks

SCHEMA = "membrane-summary/2"

# Limits on listed transitions and faults; their counters continue (a device may flicker for a
# week).
_LISTED_MAX = 1000


class Summary:
    """Accumulates everything the recorder sees; `as_dict` gives `summary.json` at any time.

    "True" is the target minus what the twin knows of the mirror's centre: on a real bench those
    keys are null.
    """

    def __init__(self, config: Config) -> None:
        self._true_um = Moments()
        least = least_ticks(1.0, config.loop.rate_hz)
        self._true_1s_um, self._reading_1s_um = (
            SecondMeans(config.limits.band_um, least) for _ in range(2)
        )
        self._reading_um = Moments()
        self._lateness_ms = LogHistogram()
        self._latency_ms = LogHistogram()
        self._rows = 0
        self._missed_ticks = 0
        self._cycles = 0
        self._rejected = 0
        self._leak_um_per_s = math.nan
        self._state = math.nan
        self._parts = HoldParts(config.limits.band_um)
        self._parts_s = dict.fromkeys(PARTS, 0.0)
        self._time_s = 0.0
        self._states: list[dict[str, Any]] = []
        self._transitions = 0
        self._faults: list[EventLine] = []
        self._standing: list[
            EventLine
        ] = []  # the fault that stands, if one does; plain data, for the state file
        self._fault_count = 0
        self._geometry: EventLine = {}
        self._end: EventLine = {}

    def add_rows(self, rows: telemetry.Rows) -> None:
        """Add (n, len(FIELDS)) telemetry rows, in order."""
        if not len(rows):
            return
        time_s = telemetry.column(rows, "mono_s")
        for row, code in telemetry.changes(telemetry.column(rows, "state"), self._state):
            self._transitions += 1
            if len(self._states) < _LISTED_MAX:
                self._states.append(
                    {"state": telemetry.State(code).name.lower(), "mono_s": float(time_s[row])}
                )
        parts = self._parts.of(telemetry.columns(rows))
        for name, part in parts.items():
            self._parts_s[name] += float(telemetry.column(rows, "dt_s")[part].sum())
        settled = telemetry.columns(rows[parts["held"]])
        self._state = float(telemetry.column(rows, "state")[-1])
        true_um = telemetry.true_error_um(settled)
        self._true_um.add(true_um)
        self._true_1s_um.add(settled["mono_s"], true_um)
        reading_um = settled["setpoint_um"] - settled["displacement_um"]
        self._reading_um.add(reading_um)
        self._reading_1s_um.add(settled["mono_s"], reading_um)
        self._lateness_ms.add(telemetry.column(rows, "lateness_ms"))
        self._rows += len(rows)
        self._missed_ticks = int(telemetry.column(rows, "missed_ticks")[-1])
        self._time_s = max(self._time_s, float(time_s[-1]))
        leak = telemetry.column(rows, "leak_um_per_s")
        leak = leak[np.isfinite(leak)]
        self._leak_um_per_s = float(leak[-1]) if leak.size else self._leak_um_per_s

    def add_event(self, line: EventLine) -> None:
        """Add one event; only those of faults and states, the geometry and the end of the run
        matter.
        """
        event = run_events.from_dict(line)
        standing = standing_fault_after(self._standing_fault(), event)
        self._standing = [] if standing is None else [standing.to_dict()]
        match event:
            case events.Fault():
                self._fault_count += 1
                if len(self._faults) < _LISTED_MAX:
                    self._faults.append(line)
            case run_events.GeometryInForce():
                self._geometry = {key: line.get(key) for key in ("hash", "file", "calibrated_utc")}
            case run_events.Ended():
                self._end = line

    def _standing_fault(self) -> events.Fault | None:
        for line in self._standing:
            event = run_events.from_dict(line)
            if isinstance(event, events.Fault):
                return event
        return None

    def add_shape(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Add the result of a measurement cycle."""
        self._cycles += 1
        self._rejected += estimate.verdict == "rejected"
        self._latency_ms.add(np.array([estimate.latency_s * 1e3]))

    def as_dict(self, dropped: dict[str, int], recorder: dict[str, Any]) -> dict[str, Any]:
        """The content of `summary.json`; NaN for missing figures.

        Parameters
        ----------
        dropped : dict
            Messages overwritten before the recorder read them, by ring ("telemetry", ...).
        recorder : dict
            The recorder's own data: files, errors.
        """
        true, means = self._true_um, self._true_1s_um.result()
        held = means if means["seconds"] else self._reading_1s_um.result()
        fault = fault_of_end(self._standing_fault(), self._end.get("exit"))
        return {
            **program.file_origin(SCHEMA),
            "exit": self._end.get("exit"),
            "duration_s": max(self._time_s, float(self._end.get("mono_s") or 0.0)),
            "true_std_um": true.std,
            "true_bias_um": true.mean if true.count else math.nan,
            "in_band_1s_fraction": means["in_band"],
            "band_1s_windows": means["seconds"],
            "settled_after_s": telemetry.SETTLED_AFTER_S,
            "sag_error_um": {"start": means["first_um"], "end": means["last_um"]},
            "held": {"of": "true" if means["seconds"] else "reading"}
            | held
            | {f"{name}_s": time_s for name, time_s in self._parts_s.items()},
            "reading_std_um": self._reading_um.std,
            "leak_um_per_s": self._leak_um_per_s,
            "lateness_ms": _quantiles(self._lateness_ms) | {"max": self._lateness_ms.largest},
            "ticks": self._rows + dropped.get("inputs", 0),
            "missed_ticks": self._missed_ticks,
            "cycles": self._cycles,
            "cycles_rejected": self._rejected,
            "cycle_latency_ms": _quantiles(self._latency_ms),
            "geometry": self._geometry,
            "states": self._states,
            "transitions": self._transitions,
            "faults": self._faults,
            "fault_count": self._fault_count,
            "ended_in": None if fault is None else fault.to_dict(),
            "dropped": dropped,
            "recorder": recorder,
            "end": self._end,
        }


def _quantiles(histogram: LogHistogram) -> dict[str, float]:
    return {"p50": histogram.quantile(0.50), "p99": histogram.quantile(0.99)}
