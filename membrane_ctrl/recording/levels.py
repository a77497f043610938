"""Overview levels: least, mean and greatest of each signal per 1 s, 10 s and 60 s, so that a month opens in seconds.

A level is a dict of columns: `time_s` (start of the window, a multiple of its length), `rows` (ticks in it), the
codes of `CODES` at its end (`fault`: the greatest) and `min_<signal>`, `mean_<signal>`, `max_<signal>`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Column = NDArray[np.float64]
Columns = dict[str, Column]

WINDOWS_S: tuple[float, ...] = (1.0, 10.0, 60.0)
# What is looked at or searched for over hours; `true_error_um` is made here, on a real bench it is NaN.
SIGNALS: tuple[str, ...] = (
    "error_um",
    "true_error_um",
    "displacement_um",
    "displacement_quality",
    "flow_um_per_s",
    "feedforward_um_per_s",
    "leak_um_per_s",
    "pump_fraction",
    "trim_um",
    "gauge_pressure_pa",
    "ambient_pressure_pa",
    "air_temperature_c",
    "lateness_ms",
    "missed_ticks",
)
CODES: tuple[str, ...] = ("state", "shape_state", "rung", "fault")
NAMES: tuple[str, ...] = (
    "time_s",
    "rows",
    *CODES,
    *(f"{kind}_{name}" for name in SIGNALS for kind in ("min", "mean", "max")),
)
# The fields of a telemetry row that a level is made of.
TICK_FIELDS: tuple[str, ...] = (
    "mono_s",
    *CODES,
    *(name for name in SIGNALS if name != "true_error_um"),
    "target_um",
    "truth_displacement_um",
)


def first_level(ticks: Mapping[str, Column]) -> Columns:
    """The 1 s level of ticks in their order; a window is given as far as it is there."""
    time_s = ticks["mono_s"]
    if not time_s.size:
        return {name: np.empty(0) for name in NAMES}
    starts, window = _windows(time_s, WINDOWS_S[0])
    level: Columns = {"time_s": window, "rows": _counts(starts, time_s.size)}
    level |= _codes(ticks, starts)
    for name in SIGNALS:
        values = true_error_um(ticks) if name == "true_error_um" else ticks[name]
        level[f"min_{name}"] = np.fmin.reduceat(values, starts)
        level[f"mean_{name}"] = _mean(values, np.ones(values.size), starts)
        level[f"max_{name}"] = np.fmax.reduceat(values, starts)
    return level


def coarser_level(level: Mapping[str, Column], window_s: float) -> Columns:
    """A level of longer windows out of a finer one; means are weighted with the number of ticks.

    Signals and codes that the finer one does not have, the coarser one has not either.
    """
    if not level["time_s"].size:
        return {name: np.empty(0) for name in level}
    starts, window = _windows(level["time_s"], window_s)
    coarse: Columns = {"time_s": window, "rows": np.add.reduceat(level["rows"], starts)}
    coarse |= _codes(level, starts)
    for name, values in level.items():
        if name.startswith("mean_"):
            coarse[name] = _mean(values, level["rows"], starts)
        elif name.startswith(("min_", "max_")):
            coarse[name] = (np.fmin if name.startswith("min_") else np.fmax).reduceat(values, starts)
    return coarse


def true_error_um(ticks: Mapping[str, Column]) -> Column:
    """Target minus true centre, with the sign of `error_um`; NaN on a real bench."""
    return ticks["target_um"] - ticks["truth_displacement_um"]


def _windows(time_s: Column, window_s: float) -> tuple[NDArray[np.intp], Column]:
    """First row of each window that has rows, and the windows' starts in s."""
    # the small part of a window: 59.9999999 is meant to be 60
    number = np.floor(time_s / window_s + 1e-9)
    starts = np.flatnonzero(np.concatenate(([True], number[1:] != number[:-1])))
    return starts, number[starts] * window_s


def _counts(starts: NDArray[np.intp], size: int) -> Column:
    return np.diff(np.append(starts, size)).astype(np.float64)


def _codes(table: Mapping[str, Column], starts: NDArray[np.intp]) -> Columns:
    size = next(iter(table.values())).size
    last = np.append(starts[1:], size) - 1
    codes = {name: np.asarray(table[name], dtype=np.float64)[last] for name in CODES if name in table}
    return codes | ({"fault": np.fmax.reduceat(table["fault"], starts)} if "fault" in table else {})


def _mean(values: Column, weights: Column, starts: NDArray[np.intp]) -> Column:
    there = np.isfinite(values)
    total = np.add.reduceat(np.where(there, weights, 0.0), starts)
    # the sum about a nearby value: 1e5 Pa and a change of mPa share one double without loss
    base = np.where(there, values, 0.0)[starts]
    offset = np.repeat(base, np.diff(np.append(starts, values.size)))
    summed = np.add.reduceat(np.where(there, (values - offset) * weights, 0.0), starts)
    return np.where(total > 0, base + summed / np.where(total > 0, total, 1.0), np.nan)
