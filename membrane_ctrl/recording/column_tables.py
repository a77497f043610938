"""What the tables beside the recording hold: every tick, three overview levels, every shape."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.recording.column_file import ColumnFile
from membrane_ctrl.recording.levels import NAMES, TICK_FIELDS, WINDOWS_S, Columns, coarser_level, first_level
from membrane_ctrl.recording.rows import Rows, column
from membrane_ctrl.telemetry import FIELDS

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
    return pa.schema([(name, pa.float64() if name in _DOUBLES else pa.float32()) for name in FIELDS])


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

    def add_rows(self, rows: Rows) -> None:
        """Take in telemetry rows in their order. Raises OSError (full disk)."""
        if not len(rows):
            return
        self._ticks.add({name: column(rows, name) for name in FIELDS})
        self._advance({name: column(rows, name) for name in TICK_FIELDS})

    def add_shape(self, estimate: ShapeEstimate) -> None:
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
