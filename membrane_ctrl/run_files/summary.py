"""`summary.json`: the figures of a run, computed as the rows come, in memory that does not grow with the run."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import shape_estimate, states, telemetry
from membrane_ctrl.model.arrays import BoolArray, Column, FloatArray
from membrane_ctrl.model.events import EventLine

# Statistics of a run of any length in a fixed amount of memory.


Values = FloatArray


class Moments:
    """Mean and standard deviation of values that come in batches.

    Batches are merged by the pairwise update of Chan, Golub and LeVeque (1979): with n, m the counts, d the
    difference of the means and S the sums of squared deviations,

        mean = mean_n + d m / (n + m),    S = S_n + S_m + d^2 n m / (n + m),

    which does not cancel when the mean is large against the deviation.
    """

    def __init__(self) -> None:
        self.count = 0
        self.mean = 0.0
        self._squares = 0.0

    def add(self, values: Values) -> None:
        """Take in a batch; values that are not finite are left out."""
        values = values[np.isfinite(values)]
        if not values.size:
            return
        mean = float(values.mean())
        delta = mean - self.mean
        total = self.count + values.size
        self._squares += float(((values - mean) ** 2).sum()) + delta**2 * self.count * values.size / total
        self.mean += delta * values.size / total
        self.count = total

    @property
    def std(self) -> float:
        """Standard deviation about the mean (divisor n, as `numpy.std`); NaN without values."""
        return math.sqrt(self._squares / self.count) if self.count else math.nan


class LogHistogram:
    """Quantiles of positive values from bins of equal ratio between `low` and `high`, which have a bin each beyond.

    A quantile is given as its bin's geometric middle, so its relative error is at most sqrt(ratio) - 1; `largest` is
    exact.
    """

    def __init__(self, low: float = 1e-3, high: float = 1e5, ratio: float = 1.02) -> None:
        self._low = low
        self._log_ratio = math.log(ratio)
        self._bins = np.zeros(math.ceil(math.log(high / low) / self._log_ratio), dtype=np.int64)
        self.count = 0
        self.largest = math.nan

    def add(self, values: Values) -> None:
        """Take in a batch; values that are not finite are left out."""
        values = values[np.isfinite(values)]
        if not values.size:
            return
        places = np.log(np.maximum(values, self._low) / self._low) / self._log_ratio
        places = np.clip(places.astype(np.int64), 0, self._bins.size - 1)
        self._bins += np.bincount(places, minlength=self._bins.size)
        self.count += values.size
        self.largest = float(np.fmax(self.largest, values.max()))

    def quantile(self, share: float) -> float:
        """The value that `share` of all values do not exceed; NaN without values."""
        if not self.count:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self._bins), share * self.count))
        return self._low * math.exp((place + 0.5) * self._log_ratio)


class SecondMeans:
    """Means over consecutive windows of one second; a window with a gap in it gives none.

    `count` windows so far, `inside` of them with a mean within `band`; means of the `first` and the `last`, or NaN.
    """

    def __init__(self, band: float, window_s: float = 1.0, gap_s: float = 0.5) -> None:
        self._band = band
        self._window_s = window_s
        self._gap_s = gap_s
        self._start_s = math.nan
        self._latest_s = math.nan
        self._sum = 0.0
        self._rows = 0
        self.count = 0
        self.inside = 0
        self.first = math.nan
        self.last = math.nan

    def add(self, time_s: float, value: float) -> None:
        """Take in one value; times rise."""
        if not time_s - self._latest_s <= self._gap_s:
            self._begin(time_s)
        elif time_s - self._start_s >= self._window_s:
            self._close()
            self._begin(time_s)
        self._latest_s = time_s
        self._sum += value
        self._rows += 1

    def _begin(self, time_s: float) -> None:
        self._start_s = time_s
        self._sum = 0.0
        self._rows = 0

    def _close(self) -> None:
        mean = self._sum / self._rows
        self.count += 1
        self.inside += abs(mean) <= self._band
        self.first = mean if self.count == 1 else self.first
        self.last = mean


SCHEMA = "membrane-summary/2"

# Rows count as settled this long after hold began and after each setpoint ramp: three closed-loop time constants
# of 1.45 s (PHYSICS, inner loop) leave 5 % of a step, of which the `settle` state has already taken most.
SETTLED_AFTER_S = 5.0
# The ramp has arrived when setpoint minus trim is this near to the target; far below the laser's 0.1 um steps.
ARRIVED_UM = 0.01
# Transitions and faults listed; the counters beside the lists go on (a device that flickers for a week).
_LISTED_MAX = 1000


class Summary:
    """Takes in everything the recorder sees; `as_dict` is `summary.json` at any moment.

    "True" is the target minus what the twin knows of the mirror's centre: on a real bench those keys are null.
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
        self._settled = Settled()
        self._time_s = 0.0
        self._states: list[dict[str, Any]] = []
        self._transitions = 0
        self._faults: list[EventLine] = []
        self._fault_count = 0
        self._geometry: EventLine = {}
        self._end: EventLine = {}

    def add_rows(self, rows: telemetry.Rows) -> None:
        """Take in (n, len(FIELDS)) telemetry rows in their order."""
        if not len(rows):
            return
        time_s = telemetry.column(rows, "mono_s")
        for row, code in telemetry.changes(telemetry.column(rows, "state"), self._state):
            self._transitions += 1
            if len(self._states) < _LISTED_MAX:
                self._states.append({"state": states.State(code).name.lower(), "mono_s": float(time_s[row])})
        settled = telemetry.columns(rows[self._settled.mask(telemetry.columns(rows))])
        self._state = float(telemetry.column(rows, "state")[-1])
        true_um = telemetry.true_error_um(settled)
        self._true_um.add(true_um)
        for moment_s, value_um in zip(settled["mono_s"], true_um, strict=True):
            if math.isfinite(value_um):
                self._true_1s_um.add(float(moment_s), float(value_um))
        self._reading_um.add(settled["setpoint_um"] - settled["displacement_um"])
        self._lateness_ms.add(telemetry.column(rows, "lateness_ms"))
        self._rows += len(rows)
        self._missed_ticks = int(telemetry.column(rows, "missed_ticks")[-1])
        self._time_s = max(self._time_s, float(time_s[-1]))
        leak = telemetry.column(rows, "leak_um_per_s")
        leak = leak[np.isfinite(leak)]
        self._leak_um_per_s = float(leak[-1]) if leak.size else self._leak_um_per_s

    def add_event(self, event: EventLine) -> None:
        """Take in one event; "fault", "geometry" and "end" matter here."""
        if event.get("kind") == "fault":
            self._fault_count += 1
            if len(self._faults) < _LISTED_MAX:
                self._faults.append(event)
        elif event.get("kind") == "geometry":
            self._geometry = {key: event.get(key) for key in ("hash", "file", "calibrated_utc")}
        elif event.get("kind") == "end":
            self._end = event

    def add_shape(self, estimate: shape_estimate.ShapeEstimate) -> None:
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
            "dropped": dropped,
            "recorder": recorder,
            "end": self._end,
        }


def _quantiles(histogram: LogHistogram) -> dict[str, float]:
    return {"p50": histogram.quantile(0.50), "p99": histogram.quantile(0.99)}


# Which ticks count as held: in `hold`, the setpoint ramp at its target, and that for some seconds.

FIELDS = ("mono_s", "state", "setpoint_um", "trim_um", "target_um")


class Settled:
    """The rule of `summary.json`, over blocks that come in their order."""

    def __init__(self) -> None:
        self._since_s = math.nan  # last moment that was not settled; NaN: not in hold

    def mask(self, block: Mapping[str, Column]) -> BoolArray:
        """(n,) true where the ticks of the next block are settled."""
        time_s = block["mono_s"]
        hold = block["state"] == states.State.HOLD
        ramp_um = block["setpoint_um"] - np.nan_to_num(block["trim_um"]) - block["target_um"]
        began = hold & ~np.concatenate(([not math.isnan(self._since_s)], hold[:-1]))
        moving = began | ~(np.abs(ramp_um) <= ARRIVED_UM)
        marks = np.where(hold & moving, time_s, -np.inf)
        if not math.isnan(self._since_s) and time_s.size and hold[0]:
            marks[0] = max(marks[0], self._since_s)
        since_s = np.maximum.accumulate(marks)
        settled = hold & (time_s - since_s >= SETTLED_AFTER_S)
        if time_s.size:
            self._since_s = float(since_s[-1]) if hold[-1] else math.nan
        return np.asarray(settled)


def held_at(level: Mapping[str, Column], time_s: Column) -> BoolArray:
    """(n,) whether the window of a level that holds each time, and the one before, were in `hold`."""
    if not level["time_s"].size:
        return np.zeros(time_s.size, dtype=bool)
    place = np.clip(np.searchsorted(level["time_s"], time_s, side="right") - 1, 0, None)
    hold = level["state"] == states.State.HOLD
    return np.asarray(hold[place] & hold[np.maximum(place - 1, 0)])
