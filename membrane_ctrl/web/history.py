"""History of a signal for the chart, from seconds to a month: of the hold on view, and of the runs before it."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from membrane_ctrl.model.arrays import Column
from membrane_ctrl.review import catalogue
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.web.feed import SIGNALS, HoldFeed

SPANS_S = {
    "1 min": 60.0, "10 min": 600.0, "1 h": 3600.0, "8 h": 28_800.0, "1 day": 86_400.0, "1 week": 604_800.0,
    "1 month": 2_678_400.0,
}  # fmt: skip
UNITS = {
    "error_um": "error, um", "displacement_um": "laser, um", "pump_fraction": "pump, share of full scale",
    "leak_um_per_s": "leak, um/s", "gauge_pressure_pa": "gauge pressure, Pa", "trim_um": "trim, um",
}  # fmt: skip
_LIVE_S = 3600.0  # the feed remembers this much; a longer span is read from the tables
_POINTS_MAX = 1200  # as many as a wide screen shows
_GAP = 3.0  # windows without data interrupt the line


@dataclass(frozen=True, slots=True)
class Series:
    """A signal over time: (n,) UTC seconds, and least, mean and largest value; NaN rows interrupt the line."""

    utc_s: Column
    low: Column
    mean: Column
    high: Column


def history(feed: HoldFeed, logs: Path | None, signal: str, span_s: float, now_s: float | None = None) -> Series:
    """The last `span_s` seconds of a signal of `SIGNALS`, in at most `_POINTS_MAX` windows.

    `logs` is the folder of the runs, None if it is on another machine: then only the last hour is known.
    """
    if signal not in SIGNALS:
        raise ValueError(f"{signal}: none of {', '.join(SIGNALS)}")
    begin_s = (time.time() if now_s is None else now_s) - span_s
    live = _of_feed(feed, signal, begin_s)
    if span_s <= _LIVE_S and live.utc_s.size and live.utc_s[0] <= begin_s + 2.0:
        return thinned(live, span_s)
    before_s = live.utc_s[0] if live.utc_s.size else math.inf
    parts = [] if logs is None or not logs.is_dir() else _of_runs(logs, signal, begin_s, float(before_s), span_s)
    return thinned(_joined([*parts, live]), span_s)


def _of_feed(feed: HoldFeed, signal: str, begin_s: float) -> Series:
    seconds = [each for each in feed.seconds.since(begin_s) if signal in each.values]
    values = np.array([each.values[signal] for each in seconds]).reshape(-1, 3)
    return Series(np.array([each.utc_s for each in seconds], dtype=np.float64), *values.T)


def _of_runs(logs: Path, signal: str, begin_s: float, end_s: float, span_s: float) -> list[Series]:
    """The signal in each run of the folder that reaches into the span, oldest first."""
    window_s = next((w for w in (1.0, 10.0) if span_s / w <= 4 * _POINTS_MAX), 60.0)
    names = [f"{kind}_{signal}" for kind in ("min", "mean", "max")]
    found = []
    for entry in catalogue.entries(logs):
        start_s = entry.started_utc.timestamp()
        duration_s = entry.duration_s if math.isfinite(entry.duration_s) else 0.0
        if start_s > end_s or start_s + duration_s < begin_s:
            continue
        try:
            level = open_run(entry.folder).level(window_s, begin_s - start_s, end_s - start_s, names)
        except (OSError, ValueError):  # one damaged run must not empty the chart
            continue
        if level["time_s"].size:
            found.append(Series(level["time_s"] + start_s, *(level[name] for name in names)))
    return found


def _joined(parts: Sequence[Series]) -> Series:
    parts = [part for part in parts if part.utc_s.size]
    if not parts:
        return Series(*(np.empty(0) for _ in range(4)))
    return Series(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("utc_s", "low", "mean", "high"))
    )


def thinned(series: Series, span_s: float) -> Series:
    """The series in windows of equal length, at most `_POINTS_MAX`; a NaN row after each gap."""
    if not series.utc_s.size:
        return series
    window_s = max(1.0, math.ceil(span_s / _POINTS_MAX))
    number = np.floor(series.utc_s / window_s)
    starts = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
    low = np.fmin.reduceat(series.low, starts)
    high = np.fmax.reduceat(series.high, starts)
    known = np.isfinite(series.mean)
    total = np.add.reduceat(np.where(known, series.mean, 0.0), starts)
    with np.errstate(invalid="ignore"):
        mean = total / np.add.reduceat(known.astype(float), starts)
    utc_s = number[starts] * window_s
    step_s = max(window_s, float(np.median(np.diff(utc_s)))) if utc_s.size > 1 else window_s
    gaps = np.flatnonzero(np.diff(utc_s) > _GAP * step_s) + 1
    at_gap = np.insert(utc_s, gaps, utc_s[gaps - 1] + step_s)
    return Series(at_gap, *(np.insert(column, gaps, np.nan) for column in (low, mean, high)))
