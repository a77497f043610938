"""What the tables beside the recording hold: every tick, what it was given, three overview levels, every shape."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from membrane_ctrl.controller.tick import RECORD, SAME, TickBatch
from membrane_ctrl.model import shape_estimate, telemetry
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.run_files import column_codec
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
        values = telemetry.true_error_um(ticks) if name == "true_error_um" else ticks[name]
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
RARE = "rare"
# By the record's field: the column that holds it, exactly. Where the row has what was made of it, `given_<name>`.
GIVEN: dict[str, str] = {
    name: SAME.get(name, f"given_{name}" if name in telemetry.FIELDS else name) for name in RECORD.names or ()
}
# What a field of the row nearly always is: stored is how it differs. All others are in singles, finer than the
# sensors behind them (1 mm to 0.1 nm), at half the size and half the reading time.
_SUMS = {
    **{name: column for name, column in GIVEN.items() if column.startswith("given_")},
    "filtered_um": "setpoint_um -error_um",
    "flow_wanted_um_per_s": "p_um_per_s i_um_per_s d_um_per_s feedforward_um_per_s",
    "flow_um_per_s": "flow_wanted_um_per_s",
}
_TICK_BATCH_S = 60.0
_RARE_BATCH_S = 600.0
# Reading back costs as much a batch as a thousand rows.
_SHAPE_BATCH_S = 300.0
# A batch costs about 6 kB whatever is in it: the coarser a level, the longer its rows wait.
_LEVEL_BATCH_S = {1.0: 300.0, 10.0: 600.0, 60.0: 3600.0}
# Reports take a covariance now and then, which `covariance_um2` has: all of a month would be 3 GB.
COVARIANCE_INTERVAL_S = 600.0
COMMANDS, MEMORY = "commands", "memory"


def level_table(window_s: float) -> str:
    """Name of the table of a level."""
    return f"levels_{window_s:.0f}s"


def tick_schema() -> pa.Schema:
    """Columns of `ticks`: the fields of a telemetry row, then what else the tick was given."""
    exact = {column.removeprefix("given_") for column in GIVEN.values()}
    rows = [
        pa.field(
            name,
            pa.float64() if name in exact else pa.float32(),
            metadata={column_codec.SUM: _SUMS[name]} if name in _SUMS else None,
        )
        for name in telemetry.FIELDS
    ]
    others = [
        pa.field(column, pa.from_numpy_dtype(RECORD[name]))
        for name, column in GIVEN.items()
        if column not in telemetry.FIELDS
    ]
    return pa.schema([*rows, *others])


def rare_schema() -> pa.Schema:
    """Columns of `rare`: the commands and ended tasks of a tick (JSON), the controller's memory before it."""
    return pa.schema([("time_s", pa.float64()), ("tick", pa.int64()), ("kind", pa.string()), ("data", pa.binary())])


def level_schema() -> pa.Schema:
    """Columns of a level."""
    wide = {"time_s", *(f"{kind}_ambient_pressure_pa" for kind in ("min", "mean", "max"))}
    return pa.schema([(name, pa.float64() if name in wide else pa.float32()) for name in NAMES])


def shape_schema() -> pa.Schema:
    """Columns of `shapes`: all of an estimate.

    `covariance_um2` is empty but for one cycle each `COVARIANCE_INTERVAL_S`, `upper_um2` has the upper half of each.
    """
    return pa.schema(
        [
            *((name, pa.float64()) for name in shape_estimate.NUMBERS),
            ("cycle", pa.int64()),
            ("tracking_lost", pa.bool_()),
            *((name, pa.string()) for name in ("kind", "verdict", "reason")),
            ("coeffs_um", pa.list_(pa.float64(), shape_estimate.TERMS)),
            ("upper_um2", pa.list_(pa.float32(), shape_estimate.UPPER_TERMS)),
            ("covariance_um2", pa.list_(pa.float32())),
        ]
    )


@dataclass(frozen=True, slots=True)
class OpenWindows:
    """Windows of the overview that are not over: what the recorder after a dead one needs to end them."""

    # rows of the open window of 1 s
    ticks: Columns = field(default_factory=lambda: {name: np.empty(0) for name in TICK_FIELDS})
    # by the coarser window in s: rows of the finer level that are in its open window
    levels: dict[float, Columns] = field(default_factory=dict)


class ColumnTables:
    """All tables of a run; `resumed` is from the recorder that died, None at the start of a run."""

    def __init__(self, run_dir: Path, resumed: OpenWindows | None = None) -> None:
        def table(name: str, schema: pa.Schema, time_name: str, batch_s: float) -> ColumnFile:
            return ColumnFile(run_dir, name, schema, time_name, batch_s, resumed is not None)

        self._ticks = table(TICKS, tick_schema(), "mono_s", _TICK_BATCH_S)
        self._rare = table(RARE, rare_schema(), "time_s", _RARE_BATCH_S)
        self._shapes = table(SHAPES, shape_schema(), "time_s", _SHAPE_BATCH_S)
        self._levels = {
            window_s: table(level_table(window_s), level_schema(), "time_s", _LEVEL_BATCH_S[window_s])
            for window_s in WINDOWS_S
        }
        windows = resumed or OpenWindows()
        self._open_ticks, self._open_levels = windows.ticks, dict(windows.levels)
        self._covariance_due_s = -math.inf

    def add_ticks(self, batch: TickBatch) -> None:
        """Take in ticks in their order. Raises OSError (full disk)."""
        if not len(batch.rows):
            return
        row = {name: telemetry.column(batch.rows, name) for name in telemetry.FIELDS}
        given = {column: batch.records[name] for name, column in GIVEN.items()}
        try:
            self._ticks.add({**row, **given})
        finally:
            self._advance({name: row[name] for name in TICK_FIELDS})
            self._add_rare(batch)

    def _add_rare(self, batch: TickBatch) -> None:
        times_s = dict(zip(batch.records["tick"].tolist(), batch.records["now_s"].tolist(), strict=True))
        parts = [(tick, MEMORY, data) for tick, data in batch.memories.items()]
        parts += [(tick, COMMANDS, data) for tick, data in batch.tails.items()]
        if parts:
            ticks, kinds, datas = zip(*sorted(parts), strict=True)
            rare = {"time_s": [times_s[tick] for tick in ticks], "tick": ticks, "kind": kinds, "data": datas}
            self._rare.add(rare)

    def add_shape(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Take in the result of a measurement cycle. Raises OSError (full disk)."""
        row: dict[str, Any] = {
            field.name: [getattr(estimate, field.name, None)] for field in shape_schema() if field.name != "upper_um2"
        }
        covariance: list[float] = []
        if estimate.verdict != "rejected" and estimate.time_s >= self._covariance_due_s:
            self._covariance_due_s = estimate.time_s + COVARIANCE_INTERVAL_S
            covariance = list(np.asarray(estimate.covariance_um2, dtype=np.float32).ravel())
        row["coeffs_um"] = [list(estimate.coeffs_um)]
        row["upper_um2"] = [shape_estimate.upper_half(estimate.covariance_um2)]
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
        """Rows of all tables that no file has."""
        return sum(file.lost for file in self._files)

    @property
    def lost_ticks(self) -> int:
        """Ticks that no file has."""
        return self._ticks.lost

    @property
    def files(self) -> dict[str, int]:
        """Files of each table: a reader that finds fewer knows that the last ones are missing."""
        levels = {level_table(window_s): file.files for window_s, file in self._levels.items()}
        return {TICKS: self._ticks.files, RARE: self._rare.files, SHAPES: self._shapes.files, **levels}

    @property
    def _files(self) -> tuple[ColumnFile, ...]:
        return (self._ticks, self._rare, self._shapes, *self._levels.values())

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
