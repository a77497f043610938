"""What the tables beside the recording hold: every tick, three overview levels, every shape."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from membrane_ctrl.model import shape_estimate, telemetry
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.run_files.column_file import ColumnFile

# Overview levels: least, mean and greatest of each signal per 1 s, 10 s and 60 s, so that a month opens in seconds.
#
# A level is a dict of columns: `time_s` (start of the window, a multiple of its length), `rows` (ticks in it), the
# codes of `CODES` at its end (`fault`: the greatest) and `min_<signal>`, `mean_<signal>`, `max_<signal>`.
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


TICKS = "ticks"
SHAPES = "shapes"
# Fields for which the 24 bits of a single would lose something: clocks, counters, and 1e5 Pa to the mPa. All others
# are finer in a single than the sensor behind them (1 mm to 0.1 nm), at half the size and half the reading time.
_DOUBLES = frozenset({"mono_s", "tick", "sample_counter", "device_time_s", "ambient_pressure_pa"})
_TICK_BATCH_S = 60.0
# Reading back costs as much a batch as a thousand rows.
_SHAPE_BATCH_S = 300.0
# A batch costs about 6 kB whatever is in it: the coarser a level, the longer its rows wait.
_LEVEL_BATCH_S = {1.0: 300.0, 10.0: 600.0, 60.0: 3600.0}
# A covariance is 5 kB and changes little from cycle to cycle.
COVARIANCE_INTERVAL_S = 600.0


def level_table(window_s: float) -> str:
    """Name of the table of a level."""
    return f"levels_{window_s:.0f}s"


def tick_schema() -> pa.Schema:
    """Columns of `ticks`: the fields of a telemetry row."""
    return pa.schema([(name, pa.float64() if name in _DOUBLES else pa.float32()) for name in telemetry.FIELDS])


def level_schema() -> pa.Schema:
    """Columns of a level."""
    wide = {"time_s", *(f"{kind}_ambient_pressure_pa" for kind in ("min", "mean", "max"))}
    return pa.schema([(name, pa.float64() if name in wide else pa.float32()) for name in NAMES])


def shape_schema() -> pa.Schema:
    """Columns of `shapes`; `covariance_um2` is empty but for one cycle each `COVARIANCE_INTERVAL_S`."""
    numbers = (
        "time_s", "cycle", "hencky_um", "sag_um", "sag_sigma_um", "displacement_um", "slope_residual_urad",
        "valid_fraction", "modulation_median_adu", "saturated_fraction", "latency_s",
    )  # fmt: skip
    return pa.schema(
        [
            *((name, pa.float64()) for name in numbers),
            *((name, pa.string()) for name in ("kind", "verdict", "reason")),
            ("coeffs_um", pa.list_(pa.float64(), 36)),
            ("covariance_um2", pa.list_(pa.float32())),
        ]
    )


@dataclass(frozen=True, slots=True)
class OpenWindows:
    """Windows of the overview that are not over: what the recorder after a dead one needs to end them.

    Attributes
    ----------
    ticks : dict
        Rows of the open window of 1 s.
    levels : dict
        By the coarser window in s: rows of the finer level that are in its open window.
    """

    ticks: Columns = field(default_factory=lambda: {name: np.empty(0) for name in TICK_FIELDS})
    levels: dict[float, Columns] = field(default_factory=dict)


class ColumnTables:
    """All tables of a run; takes in what the recorder takes in.

    Parameters
    ----------
    run_dir : Path
        Folder of the run.
    resumed : OpenWindows or None
        From the recorder that died; None at the start of a run.
    """

    def __init__(self, run_dir: Path, resumed: OpenWindows | None = None) -> None:
        def table(name: str, schema: pa.Schema, time_name: str, batch_s: float) -> ColumnFile:
            return ColumnFile(run_dir, name, schema, time_name, batch_s, resumed is not None)

        self._ticks = table(TICKS, tick_schema(), "mono_s", _TICK_BATCH_S)
        self._shapes = table(SHAPES, shape_schema(), "time_s", _SHAPE_BATCH_S)
        self._levels = {
            window_s: table(level_table(window_s), level_schema(), "time_s", _LEVEL_BATCH_S[window_s])
            for window_s in WINDOWS_S
        }
        windows = resumed or OpenWindows()
        self._open_ticks, self._open_levels = windows.ticks, dict(windows.levels)
        self._covariance_due_s = -math.inf

    def add_rows(self, rows: telemetry.Rows) -> None:
        """Take in telemetry rows in their order. Raises OSError (full disk)."""
        if not len(rows):
            return
        self._ticks.add({name: telemetry.column(rows, name) for name in telemetry.FIELDS})
        self._advance({name: telemetry.column(rows, name) for name in TICK_FIELDS})

    def add_shape(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Take in the result of a measurement cycle. Raises OSError (full disk)."""
        row: dict[str, Any] = {
            field.name: [getattr(estimate, field.name)] for field in shape_schema() if field.name != "covariance_um2"
        }
        covariance: list[float] = []
        if estimate.verdict != "rejected" and estimate.time_s >= self._covariance_due_s:
            self._covariance_due_s = estimate.time_s + COVARIANCE_INTERVAL_S
            covariance = list(np.asarray(estimate.covariance_um2, dtype=np.float32).ravel())
        row["coeffs_um"] = [list(estimate.coeffs_um)]
        self._shapes.add({**row, "covariance_um2": [covariance]})

    @property
    def open_windows(self) -> OpenWindows:
        """To hand on."""
        return OpenWindows(self._open_ticks, self._open_levels)

    def sync(self) -> None:
        """Wait until the disk has all rows, also those of batches that are not full. Raises OSError (full disk)."""
        for file in self._files:
            file.sync()

    def close(self) -> None:
        """Write the windows still open and end all files. Raises OSError."""
        self._advance(None)
        for file in self._files:
            file.close()

    def leave_folder(self) -> None:
        """The run's folder was taken away, and another is in its place: go on there."""
        for file in self._files:
            file.leave_folder()

    @property
    def lost(self) -> int:
        """Rows of all tables given up."""
        return sum(file.lost for file in self._files)

    @property
    def files(self) -> dict[str, int]:
        """Files of each table: a reader that finds fewer knows that the last ones are missing."""
        levels = {level_table(window_s): file.files for window_s, file in self._levels.items()}
        return {TICKS: self._ticks.files, SHAPES: self._shapes.files, **levels}

    @property
    def _files(self) -> tuple[ColumnFile, ...]:
        return (self._ticks, self._shapes, *self._levels.values())

    def _advance(self, new: Columns | None) -> None:
        """Close the windows that are over (all, if nothing new comes) and hand them to the next coarser level."""
        ticks = self._open_ticks
        if new is not None:
            ticks = {name: np.concatenate((ticks[name], new[name])) for name in TICK_FIELDS}
        done = ticks["mono_s"].size if new is None else _first_of_last(ticks["mono_s"], WINDOWS_S[0])
        self._open_ticks = {name: values[done:] for name, values in ticks.items()}
        level = first_level({name: values[:done] for name, values in ticks.items()})
        for place, window_s in enumerate(WINDOWS_S):
            self._levels[window_s].add(level)
            if place + 1 == len(WINDOWS_S):
                return
            coarse_s = WINDOWS_S[place + 1]
            waiting = self._open_levels.get(coarse_s)
            if waiting is not None:
                level = {name: np.concatenate((waiting[name], level[name])) for name in NAMES}
            done = level["time_s"].size if new is None else _first_of_last(level["time_s"], coarse_s)
            self._open_levels[coarse_s] = {name: values[done:] for name, values in level.items()}
            level = coarser_level({name: values[:done] for name, values in level.items()}, coarse_s)


def _first_of_last(time_s: np.ndarray, window_s: float) -> int:
    """Rows before the window that the last row is in: that one may go on."""
    if not time_s.size:
        return 0
    number = np.floor(time_s / window_s + 1e-9)
    return int(np.searchsorted(number, number[-1]))
