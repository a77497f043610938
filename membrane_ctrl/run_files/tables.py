"""The tables beside the recording: every tick with its inputs, three overview levels, every shape."""

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
from membrane_ctrl.model.columns import AGGREGATED, COLUMNS, TRUE_ERROR_COLUMN, Aggregation, Kind
from membrane_ctrl.model.zernike_terms import COVARIANCE_UPPER_SIZE, ZERNIKE_TERMS
from membrane_ctrl.run_files import column_codec
from membrane_ctrl.run_files.column_file import ColumnFile

# Overview levels: minimum, mean and maximum of each signal per 1, 10 and 60 s, so that a month opens in seconds.
#
# A level is a dict of columns: `time_s` (start of the window, a multiple of its length), `rows` (ticks in it), the
# codes at its end (of some the largest) and `min_<signal>`, `mean_<signal>`, `max_<signal>`.
Columns = dict[str, Column]

WINDOWS_S: tuple[float, ...] = (1.0, 10.0, 60.0)
# Minimum, mean and maximum of these, and the codes, as the table of columns says.
SIGNALS: tuple[str, ...] = tuple(each.name for each in AGGREGATED)
CODES: tuple[str, ...] = tuple(each.name for each in COLUMNS.values() if each.kind is Kind.CODE)
_LARGEST = tuple(name for name in CODES if COLUMNS[name].aggregation is Aggregation.LARGEST)
NAMES: tuple[str, ...] = (
    "time_s",
    "rows",
    *CODES,
    *(f"{kind}_{name}" for name in SIGNALS for kind in ("min", "mean", "max")),
)
# The telemetry fields from which levels are computed.
_OF_TRUE_ERROR = ("target_um", "truth_displacement_um")
TICK_FIELDS: tuple[str, ...] = tuple(
    dict.fromkeys(("mono_s", *CODES, *(name for name in SIGNALS if name in COLUMNS), *_OF_TRUE_ERROR))
)


def first_level(ticks: Mapping[str, Column]) -> Columns:
    """The 1 s level of consecutive ticks; incomplete windows are included."""
    time_s = ticks["mono_s"]
    if not time_s.size:
        return {name: np.empty(0) for name in NAMES}
    starts, window = _windows(time_s, WINDOWS_S[0])
    level: Columns = {"time_s": window, "rows": _counts(starts, time_s.size)}
    level |= _codes(ticks, starts)
    for name in SIGNALS:
        values = telemetry.true_error_um(ticks) if name == TRUE_ERROR_COLUMN.name else ticks[name]
        level[f"min_{name}"] = np.fmin.reduceat(values, starts)
        level[f"mean_{name}"] = _mean(values, np.ones(values.size), starts)
        level[f"max_{name}"] = np.fmax.reduceat(values, starts)
    return level


def coarser_level(level: Mapping[str, Column], window_s: float) -> Columns:
    """A level of longer windows from a finer one; means are weighted by the number of ticks.

    The coarser level lacks the signals and codes that the finer one lacks.
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
    """First row of each non-empty window, and the windows' starts in s."""
    # a small fraction of a window: 59.9999999 means 60
    number = np.floor(time_s / window_s + 1e-9)
    starts = np.flatnonzero(np.concatenate(([True], number[1:] != number[:-1])))
    return starts, number[starts] * window_s


def _counts(starts: NDArray[np.intp], size: int) -> Column:
    return np.diff(np.append(starts, size)).astype(np.float64)


def _codes(table: Mapping[str, Column], starts: NDArray[np.intp]) -> Columns:
    size = next(iter(table.values())).size
    last = np.append(starts[1:], size) - 1
    codes = {name: np.asarray(table[name], dtype=np.float64)[last] for name in CODES if name in table}
    return codes | {name: np.fmax.reduceat(table[name], starts) for name in _LARGEST if name in table}


def _mean(values: Column, weights: Column, starts: NDArray[np.intp]) -> Column:
    there = np.isfinite(values)
    total = np.add.reduceat(np.where(there, weights, 0.0), starts)
    # sum relative to a nearby value: a double can then hold 1e5 Pa and a change of mPa without loss
    base = np.where(there, values, 0.0)[starts]
    offset = np.repeat(base, np.diff(np.append(starts, values.size)))
    summed = np.add.reduceat(np.where(there, (values - offset) * weights, 0.0), starts)
    return np.where(total > 0, base + summed / np.where(total > 0, total, 1.0), np.nan)


TICKS = "ticks"
SHAPES = "shapes"
RARE = "rare"
# By the record's field: the column that holds its exact value; `given_<name>` if the row has a derived value.
GIVEN: dict[str, str] = {
    name: SAME.get(name, f"given_{name}" if name in telemetry.FIELDS else name) for name in RECORD.names or ()
}
# What a field of the row nearly always equals: the difference is stored. All others are single precision, finer than
# their sensors (1 mm to 0.1 nm), at half the size and reading time.
_SUMS = {
    **{name: column for name, column in GIVEN.items() if column.startswith("given_")},
    "filtered_um": "setpoint_um -error_um",
    "flow_wanted_um_per_s": "p_um_per_s i_um_per_s d_um_per_s feedforward_um_per_s",
    "flow_um_per_s": "flow_wanted_um_per_s",
}
_TICK_BATCH_S = 60.0
_RARE_BATCH_S = 600.0
# Reading back a batch costs as much as a thousand rows.
_SHAPE_BATCH_S = 300.0
# A batch costs about 6 kB whatever its content: the coarser a level, the longer its rows wait.
_LEVEL_BATCH_S = {1.0: 300.0, 10.0: 600.0, 60.0: 3600.0}
# Reports need a covariance only now and then, in `covariance_um2`: a month of all would be 3 GB.
COVARIANCE_INTERVAL_S = 600.0
COMMANDS, MEMORY = "commands", "memory"


def level_table(window_s: float) -> str:
    """Name of the table of a level."""
    return f"levels_{window_s:.0f}s"


def tick_schema() -> pa.Schema:
    """Columns of `ticks`: the fields of a telemetry row, then the tick's other inputs."""
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
    """Columns of `rare`: a tick's commands and ended tasks (JSON), and the controller's memory before it."""
    return pa.schema([("time_s", pa.float64()), ("tick", pa.int64()), ("kind", pa.string()), ("data", pa.binary())])


def level_schema() -> pa.Schema:
    """Columns of a level."""
    wide = {"time_s", *(f"{kind}_ambient_pressure_pa" for kind in ("min", "mean", "max"))}
    return pa.schema([(name, pa.float64() if name in wide else pa.float32()) for name in NAMES])


def shape_schema() -> pa.Schema:
    """Columns of `shapes`: complete estimates.

    `covariance_um2` is set for one cycle per `COVARIANCE_INTERVAL_S`, `upper_um2` has every upper half.
    """
    return pa.schema(
        [
            *((name, pa.float64()) for name in shape_estimate.NUMBERS),
            ("cycle", pa.int64()),
            ("tracking_lost", pa.bool_()),
            *((name, pa.string()) for name in ("kind", "verdict", "reason")),
            ("coeffs_um", pa.list_(pa.float64(), ZERNIKE_TERMS)),
            ("upper_um2", pa.list_(pa.float32(), COVARIANCE_UPPER_SIZE)),
            ("covariance_um2", pa.list_(pa.float32())),
        ]
    )


@dataclass(frozen=True, slots=True)
class OpenWindows:
    """Unfinished windows of the overview, which a successor of a dead recorder needs to finish."""

    # rows of the open 1 s window
    ticks: Columns = field(default_factory=lambda: {name: np.empty(0) for name in TICK_FIELDS})
    # by the coarser window in s: rows of the finer level in its open window
    levels: dict[float, Columns] = field(default_factory=dict)


class ColumnTables:
    """All tables of a run; `resumed` is the state of a dead recorder, None at the start of a run."""

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
        """Add ticks, in order. Raises OSError (full disk)."""
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
        """Add the result of a measurement cycle. Raises OSError (full disk)."""
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
        """Unfinished windows, for a successor."""
        return OpenWindows(self._open_ticks, self._open_levels)

    def sync(self) -> None:
        """Sync all rows, including those of unfinished batches. Raises OSError (full disk)."""
        for file in self._files:
            file.sync()

    def close(self) -> None:
        """Write the open windows and end all files. Raises OSError."""
        self._advance(None)
        for file in self._files:
            file.close()

    def leave_folder(self) -> None:
        """Continue in the folder that replaces the run's removed one."""
        for file in self._files:
            file.leave_folder()

    @property
    def lost(self) -> int:
        """Number of lost rows, over all tables."""
        return sum(file.lost for file in self._files)

    @property
    def lost_ticks(self) -> int:
        """Number of lost ticks."""
        return self._ticks.lost

    @property
    def files(self) -> dict[str, int]:
        """Number of files per table: a reader that finds fewer knows that the last ones are missing."""
        levels = {level_table(window_s): file.files for window_s, file in self._levels.items()}
        return {TICKS: self._ticks.files, RARE: self._rare.files, SHAPES: self._shapes.files, **levels}

    @property
    def _files(self) -> tuple[ColumnFile, ...]:
        return (self._ticks, self._rare, self._shapes, *self._levels.values())

    def _advance(self, new: Columns | None) -> None:
        """Close finished windows (all, at the end) and pass them to the next coarser level."""
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
    """Number of rows before the last row's window, which may be unfinished."""
    if not time_s.size:
        return 0
    number = np.floor(time_s / window_s + 1e-9)
    return int(np.searchsorted(number, number[-1]))
