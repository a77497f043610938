"""`summary.json`: the figures of a run, computed as the rows come, in memory that does not grow with the run."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from membrane_ctrl.config import Config
from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.names import State
from membrane_ctrl.recording.events import Event
from membrane_ctrl.recording.rows import Rows, changes, column
from membrane_ctrl.recording.statistics import LogHistogram, Moments, SecondMeans

SCHEMA = "membrane-summary/1"

# Rows count as settled this long after hold began and after each setpoint ramp: three closed-loop time constants
# of 1.45 s (PHYSICS, inner loop) leave 5 % of a step, of which the `settle` state has already taken most.
SETTLED_AFTER_S = 5.0
# The ramp has arrived when setpoint minus trim is this near to the target; far below the laser's 0.1 um steps.
ARRIVED_UM = 0.01
# Transitions and faults listed; the counters beside the lists go on (a device that flickers for a week).
_LISTED_MAX = 1000


class Summary:
    """Takes in everything the recorder sees; `as_dict` is `summary.json` at any moment.

    "True" is what the twin knows of the mirror's centre, minus the target: on a real bench those keys are null.
    """

    def __init__(self, config: Config) -> None:
        self._true_um = Moments()
        self._true_1s_um = SecondMeans(config.limits.band_um)
        self._reading_um = Moments()
        self._lateness_ms = LogHistogram()
        self._latency_ms = LogHistogram()
        self._rows = 0
        self._missed_ticks = 0
        self._cycles = 0
        self._rejected = 0
        self._leak_um_per_s = math.nan
        self._state = math.nan
        self._unsettled_s = math.nan  # last moment that was not settled; NaN: outside hold
        self._time_s = 0.0
        self._states: list[dict[str, Any]] = []
        self._transitions = 0
        self._faults: list[Event] = []
        self._fault_count = 0
        self._geometry: Event = {}
        self._end: Event = {}

    def add_rows(self, rows: Rows) -> None:
        """Take in (n, len(FIELDS)) telemetry rows in their order."""
        if not len(rows):
            return
        time_s = column(rows, "mono_s")
        for row, code in changes(column(rows, "state"), self._state):
            self._transitions += 1
            if len(self._states) < _LISTED_MAX:
                self._states.append({"state": State(code).name.lower(), "mono_s": float(time_s[row])})
        settled = rows[self._settled(rows)]
        self._state = float(column(rows, "state")[-1])
        true_um = column(settled, "truth_displacement_um") - column(settled, "target_um")
        self._true_um.add(true_um)
        for moment_s, value_um in zip(column(settled, "mono_s"), true_um, strict=True):
            if math.isfinite(value_um):
                self._true_1s_um.add(float(moment_s), float(value_um))
        self._reading_um.add(column(settled, "displacement_um") - column(settled, "setpoint_um"))
        self._lateness_ms.add(column(rows, "lateness_ms"))
        self._rows += len(rows)
        self._missed_ticks = int(column(rows, "missed_ticks")[-1])
        self._time_s = max(self._time_s, float(time_s[-1]))
        leak = column(rows, "leak_um_per_s")
        leak = leak[np.isfinite(leak)]
        self._leak_um_per_s = float(leak[-1]) if leak.size else self._leak_um_per_s

    def _settled(self, rows: Rows) -> list[bool]:
        """Which rows are in hold, with the setpoint ramp at its target, since `SETTLED_AFTER_S`."""
        ramp_um = column(rows, "setpoint_um") - np.nan_to_num(column(rows, "trim_um")) - column(rows, "target_um")
        hold = column(rows, "state") == State.HOLD
        settled = []
        for moment_s, holding, rest_um in zip(column(rows, "mono_s"), hold, ramp_um, strict=True):
            if not holding:
                self._unsettled_s = math.nan
            elif math.isnan(self._unsettled_s) or not abs(rest_um) <= ARRIVED_UM:
                self._unsettled_s = float(moment_s)
            settled.append(bool(holding and moment_s - self._unsettled_s >= SETTLED_AFTER_S))
        return settled

    def add_event(self, event: Event) -> None:
        """Take in one event; "fault", "geometry" and "end" matter here."""
        if event.get("kind") == "fault":
            self._fault_count += 1
            if len(self._faults) < _LISTED_MAX:
                self._faults.append(event)
        elif event.get("kind") == "geometry":
            self._geometry = {key: event.get(key) for key in ("hash", "file", "calibrated_utc")}
        elif event.get("kind") == "end":
            self._end = event

    def add_shape(self, estimate: ShapeEstimate) -> None:
        """Take in the result of a measurement cycle."""
        self._cycles += 1
        self._rejected += estimate.verdict == "rejected"
        self._latency_ms.add(np.array([estimate.latency_s * 1e3]))

    def as_dict(self, dropped: dict[str, int], recorder: dict[str, Any]) -> dict[str, Any]:
        """`summary.json`; NaN where there is nothing to say.

        Parameters
        ----------
        dropped : dict
            Messages that were overwritten before the recorder read them, by ring ("telemetry", ...).
        recorder : dict
            The recorder's own account: files, errors.
        """
        true, means = self._true_um, self._true_1s_um
        return {
            "schema": SCHEMA,
            "exit": self._end.get("exit"),
            "duration_s": max(self._time_s, float(self._end.get("mono_s") or 0.0)),
            "true_std_um": true.std,
            "true_bias_um": true.mean if true.count else math.nan,
            "in_band_1s_fraction": means.inside / means.count if means.count else math.nan,
            "band_1s_windows": means.count,
            "settled_after_s": SETTLED_AFTER_S,
            "sag_error_um": {"start": means.first, "end": means.last},
            "reading_std_um": self._reading_um.std,
            "leak_um_per_s": self._leak_um_per_s,
            "lateness_ms": _quantiles(self._lateness_ms) | {"max": self._lateness_ms.largest},
            "ticks": self._rows + dropped.get("telemetry", 0),
            "missed_ticks": self._missed_ticks,
            "cycles": self._cycles,
            "cycles_rejected": self._rejected,
            "cycle_latency_ms": _quantiles(self._latency_ms),
            "geometry": self._geometry,
            "states": self._states,
            "transitions": self._transitions,
            "faults": self._faults,
            "fault_count": self._fault_count,
            "dropped": dropped,
            "recorder": recorder,
            "end": self._end,
        }


def _quantiles(histogram: LogHistogram) -> dict[str, float]:
    return {"p50": histogram.quantile(0.50), "p99": histogram.quantile(0.99)}
