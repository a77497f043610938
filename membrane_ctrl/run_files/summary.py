"""`summary.json`: the figures of a run, computed on the fly in constant memory."""

import copy
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import events, program, run_events, shape_estimate, telemetry
from membrane_ctrl.model.arrays import BoolArray, Column, FloatArray
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.model.standing_fault import fault_of_end, standing_fault_after

# Statistics of a run of any length in constant memory.


Values = FloatArray


class Moments:
    """Mean and standard deviation of values that arrive in batches.

    Batches are merged by the pairwise update of Chan, Golub and LeVeque (1979): with n, m the
    counts, d the difference of the means and S the sums of squared deviations,

        mean = mean_n + d m / (n + m),    S = S_n + S_m + d^2 n m / (n + m),

    which avoids cancellation when the mean is large compared with the deviation.
    """

    def __init__(self) -> None:
        self.count = 0
        self.mean = 0.0
        self._squares = 0.0

    def add(self, values: Values) -> None:
        """Add a batch, ignoring values that are not finite."""
        values = values[np.isfinite(values)]
        if not values.size:
            return
        mean = float(values.mean())
        delta = mean - self.mean
        total = self.count + values.size
        self._squares += (
            float(((values - mean) ** 2).sum()) + delta**2 * self.count * values.size / total
        )
        self.mean += delta * values.size / total
        self.count = total

    @property
    def std(self) -> float:
        """Standard deviation about the mean (divisor n, as `numpy.std`); NaN without values."""
        return math.sqrt(self._squares / self.count) if self.count else math.nan


class LogHistogram:
    """Quantiles of positive values from bins of equal ratio between `low` and `high`, with one more
    bin beyond each.

    A quantile is its bin's geometric middle, so its relative error is at most sqrt(ratio) - 1;
    `largest` is exact.
    """

    def __init__(self, low: float = 1e-3, high: float = 1e5, ratio: float = 1.02) -> None:
        self._low = low
        self._log_ratio = math.log(ratio)
        self._bins = np.zeros(math.ceil(math.log(high / low) / self._log_ratio), dtype=np.int64)
        self.count = 0
        self.largest = math.nan

    def add(self, values: Values) -> None:
        """Add a batch, ignoring values that are not finite."""
        values = values[np.isfinite(values)]
        if not values.size:
            return
        places = np.log(np.maximum(values, self._low) / self._low) / self._log_ratio
        places = np.clip(places.astype(np.int64), 0, self._bins.size - 1)
        self._bins += np.bincount(places, minlength=self._bins.size)
        self.count += values.size
        self.largest = float(np.fmax(self.largest, values.max()))

    def quantile(self, share: float) -> float:
        """The value not exceeded by `share` of all values; NaN without values."""
        if not self.count:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self._bins), share * self.count))
        return self._low * math.exp((place + 0.5) * self._log_ratio)


# A window with fewer of its ticks than this says nothing of its length.
_LEAST_SHARE = 0.9


def least_ticks(window_s: float, rate_hz: float) -> float:
    """Ticks that a window must have: nine tenths, or all but one, which may have come just behind
    its end.
    """
    ticks = window_s * rate_hz
    return min(_LEAST_SHARE * ticks, ticks - 1)


class SecondMeans:
    """Means of the seconds of the run that have at least `least` values; `result` is that of all
    until now.
    """

    def __init__(self, band: float, least: float) -> None:
        self._band = band
        self._least = least
        self._second = self._count = self._sum = 0.0  # of the last second, which may go on
        self._means = Moments()
        self._inside = 0
        self._first = self._last = math.nan

    def add(self, time_s: Column, values: Column) -> None:
        """Take in (n,) values at their times, which rise;
        those that are not finite are left out.
        """
        there = np.isfinite(values)
        second = np.append(self._second, np.floor(time_s[there] + 1e-9))
        starts = np.flatnonzero(np.diff(second, prepend=np.nan))
        counts = np.add.reduceat(np.append(self._count, np.ones(second.size - 1)), starts)
        sums = np.add.reduceat(np.append(self._sum, values[there]), starts)
        self._second, self._count, self._sum = float(second[-1]), float(counts[-1]), float(sums[-1])
        self._take(counts[:-1], sums[:-1])

    def _take(self, counts: Column, sums: Column) -> None:
        whole = counts >= self._least
        means = sums[whole] / counts[whole]
        self._means.add(means)
        self._inside += int((np.abs(means) <= self._band).sum())
        if means.size:
            self._first, self._last = (
                float(means[0]) if math.isnan(self._first) else self._first,
                float(means[-1]),
            )

    def result(self) -> dict[str, float]:
        """Number of seconds; mean, standard deviation, first and last of their means; share within
        the band.
        """
        all_of = copy.deepcopy(self)
        all_of._take(np.array([self._count]), np.array([self._sum]))
        count = all_of._means.count
        return {
            "seconds": count,
            "mean_um": all_of._means.mean if count else math.nan,
            "std_um": all_of._means.std if count > 1 else math.nan,
            "in_band": all_of._inside / count if count else math.nan,
            "first_um": all_of._first,
            "last_um": all_of._last,
        }


SCHEMA = "membrane-summary/2"

# The ramp has ended when setpoint minus trim is this near the target; far below the laser's 0.1 µm
# steps.
ARRIVED_UM = 0.01
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


# What counts as held: in `hold`, the setpoint ramp at its target, no pause, no fault, and that for
# some seconds.

FIELDS = (
    "mono_s",
    "state",
    "safe_level",
    "setpoint_um",
    "trim_um",
    "target_um",
    "displacement_um",
    "error_um",
    "p_um_per_s",
)
PARTS = ("held", "faults", "paused", "moving")
# A mirror that was let go (a pause, a fault's mean flow) may have strayed: it counts again once it
# has stayed in the band, and after this time in any case.
_BACK_WITHIN_S = 60.0


class HoldParts:
    """Parts of a run's ticks, over blocks that come in their order.

    `held` is the settled hold; `faults`: a safe level is in force; `paused`; `moving`: in
    `hold`, the setpoint on its way, or not yet settled after that or after what let the mirror go.
    """

    def __init__(self, band_um: float) -> None:
        self._band_um = band_um
        self._since_s = math.nan  # last unsettled time; NaN: not in hold
        self._let_go_s = math.nan  # last moment that nothing held it; NaN: it has been back since
        self._away_s = math.nan  # last moment that it was outside the band since

    def of(self, block: Mapping[str, Column]) -> dict[str, BoolArray]:
        """(n,) masks of the next block by the names of `PARTS`; no tick is in two."""
        time_s, hold = block["mono_s"], block["state"] == telemetry.State.HOLD
        faults = block["safe_level"] > 0
        # a loop that follows its error has a proportional part; a lost reading alone is no pause
        open_loop = (
            (block["p_um_per_s"] == 0)
            & (block["error_um"] != 0)
            & np.isfinite(block["displacement_um"])
        )
        paused = hold & ~faults & open_loop
        ramp_um = block["setpoint_um"] - np.nan_to_num(block["trim_um"]) - block["target_um"]
        began = hold & ~np.concatenate(([not math.isnan(self._since_s)], hold[:-1]))
        away = paused | faults | self._straying(block, paused | (faults & hold))
        marks = np.where(hold & (began | away | ~(np.abs(ramp_um) <= ARRIVED_UM)), time_s, -np.inf)
        if not math.isnan(self._since_s) and time_s.size and hold[0]:
            marks[0] = max(marks[0], self._since_s)
        since_s = np.maximum.accumulate(marks)
        held = hold & (time_s - since_s >= telemetry.SETTLED_AFTER_S)
        if time_s.size:
            self._since_s = float(since_s[-1]) if hold[-1] else math.nan
        return {
            "held": held,
            "faults": faults,
            "paused": paused,
            "moving": hold & ~(held | paused | faults),
        }

    def _straying(self, block: Mapping[str, Column], let_go: BoolArray) -> BoolArray:
        """(n,) the ticks outside the band from the moment that it is held again until it has stayed
        inside.
        """
        time_s, outside = block["mono_s"], ~(np.abs(block["error_um"]) <= self._band_um)
        straying = np.zeros(time_s.size, dtype=bool)
        for first in np.flatnonzero(
            ~let_go & np.concatenate(([not math.isnan(self._let_go_s)], let_go[:-1]))
        ):
            gone_s, away_s = (
                (time_s[first - 1], time_s[first - 1]) if first else (self._let_go_s, self._away_s)
            )
            rows = first + np.flatnonzero((outside & (time_s <= gone_s + _BACK_WITHIN_S))[first:])
            away = np.append(away_s, time_s[rows])
            stayed = np.flatnonzero(np.diff(away, append=time_s[-1]) >= telemetry.SETTLED_AFTER_S)
            count = int(stayed[0]) if stayed.size else rows.size
            straying[rows[:count]] = True
            over = stayed.size or time_s[-1] > gone_s + _BACK_WITHIN_S
            self._let_go_s, self._away_s = (
                (math.nan, math.nan) if over else (float(gone_s), float(away[count]))
            )
        if let_go.size and let_go[-1]:
            self._let_go_s = self._away_s = float(time_s[-1])
        return straying


def held_at(level: Mapping[str, Column], time_s: Column) -> BoolArray:
    """(n,) whether the mirror was settled in `hold` at each time, as far as the windows of a level
    tell.
    """
    if not level["time_s"].size:
        return np.zeros(time_s.size, dtype=bool)
    place = np.clip(np.searchsorted(level["time_s"], time_s, side="right") - 1, 0, None)
    hold = level["state"] == telemetry.State.HOLD
    since_s = np.maximum.accumulate(np.where(hold, -np.inf, np.append(level["time_s"][1:], np.inf)))
    return np.asarray(hold[place] & (time_s - since_s[place] >= telemetry.SETTLED_AFTER_S))
