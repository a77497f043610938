"""Writes the tables of a run: ticks with their inputs, levels, shapes, events, thumbnails."""

import json
import math
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from membrane_ctrl.controller.tick_assembler import TickBatch
from membrane_ctrl.model import shape_estimate, telemetry
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.model.columns import COLUMNS, Kind
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.run_files import event_log, levels, table_fields, table_specs
from membrane_ctrl.run_files.figure_minutes import FigureMinute
from membrane_ctrl.run_files.table_store.spec import TableSpec
from membrane_ctrl.run_files.table_store.writer import TableWriter

_MISSING_BITS = np.float64(math.nan).view(np.uint64)


class RunTables:
    """All tables of a run.

    Parameters
    ----------
    run_dir : Path
        Folder of the run; each table has a folder in it.
    origin_utc : datetime, optional
        UTC at 0 s of the run, for the times of events.
    resumed : OpenWindows, optional
        The state of a dead recorder; None at the start of a run.
    """

    def __init__(
        self,
        run_dir: Path,
        origin_utc: datetime | None = None,
        resumed: levels.OpenWindows | None = None,
    ) -> None:
        self._origin_utc = origin_utc
        specs = map(table_specs.with_origin, table_specs.ALL)
        self._writers = {
            spec.name: TableWriter(run_dir, spec, resumed is not None) for spec in specs
        }
        self._windows = resumed or levels.OpenWindows()
        self._covariance_due_s = -math.inf

    def add_ticks(self, batch: TickBatch) -> None:
        """Add ticks, in order."""
        if not len(batch.rows):
            return
        row = {name: telemetry.get_column(batch.rows, name) for name in telemetry.FIELDS}
        self._open_writer(table_specs.TICKS).add_rows(_tick_rows(row))
        self._open_writer(table_specs.INPUTS).add_rows(_input_rows(batch))
        self._add_rare(batch)
        self._add_levels({name: row[name] for name in levels.TICK_FIELDS})

    def _add_rare(self, batch: TickBatch) -> None:
        times_s = dict(
            zip(batch.records["tick"].tolist(), batch.records["now_s"].tolist(), strict=True)
        )
        for spec, parts in (
            (table_specs.RARE, batch.tails),
            (table_specs.SNAPSHOTS, batch.snapshots),
        ):
            rows = [
                {"time_s": times_s[tick], "tick": tick, "json": text.decode()}
                for tick, text in sorted(parts.items())
            ]
            self._add_dicts(spec, rows)

    def _add_levels(self, new: levels.Columns | None) -> None:
        for window_s, rows in self._windows.finished_rows(new):
            spec = table_specs.LEVELS[window_s]
            if rows["time_s"].size:
                self._open_writer(spec).add_rows(_nullable_rows(spec, rows))

    def add_shape(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Add the result of a measurement cycle, or of a tracked frame."""
        if estimate.kind == "track":
            spec = table_specs.TRACKED
        else:
            spec = table_specs.SHAPES
        # The row of the table, with the terms' sigmas and the upper half of the covariance.
        row = {
            name: getattr(estimate, name) for name in spec.schema.names if hasattr(estimate, name)
        }
        numbers = {name: _or_none(row[name]) for name in shape_estimate.NUMBERS}
        variances_um2 = np.maximum(np.diag(estimate.covariance_um2), 0.0)
        arrays = {
            "coeffs_um": np.asarray(estimate.coeffs_um, dtype=np.float64),
            "sigma_um": np.sqrt(variances_um2).astype(np.float32),
            "upper_um2": shape_estimate.take_upper_half(estimate.covariance_um2),
        }
        self._add_dicts(spec, [{**row, **numbers, **arrays}])
        self._add_figure_minute(self._windows.figures.add_figure(estimate))
        # The whole covariance once in a while: it hardly changes.
        if estimate.verdict != "rejected" and estimate.time_s >= self._covariance_due_s:
            self._covariance_due_s = estimate.time_s + table_specs.COVARIANCE_INTERVAL_S
            covariance = np.asarray(estimate.covariance_um2, dtype=np.float32).ravel()
            self._add_dicts(
                table_specs.COVARIANCES, [{"time_s": estimate.time_s, "covariance_um2": covariance}]
            )

    def _add_figure_minute(self, ended: FigureMinute | None) -> None:
        if ended is None:
            return
        row = {
            "time_s": ended.time_s,
            "figures": ended.figures,
            "coeffs_um": ended.coeffs_um.astype(np.float32),
            "scatter_um": ended.scatter_um.astype(np.float32),
        }
        self._add_dicts(table_specs.FIGURE_MINUTES, [row])

    def add_events(self, lines: Sequence[EventLine]) -> None:
        """Add new lines of the event log; marks are also in a table of their own."""
        first = self._next_number(table_specs.EVENTS)
        rows = [self._event_row(number, line) for number, line in enumerate(lines, start=first)]
        self._add_dicts(table_specs.EVENTS, rows)
        marks = [
            row
            for row, line in zip(rows, lines, strict=True)
            if event_log.parse_logged_line(line).line["kind"] == "mark"
        ]
        self._add_dicts(table_specs.MARKS, marks)

    def _event_row(self, number: int, line: EventLine) -> dict[str, Any]:
        time_s = float(line.get("mono_s") or 0.0)
        moment = None
        if self._origin_utc is not None:
            moment = self._origin_utc + timedelta(seconds=time_s)
        return {
            "number": number,
            "time_s": time_s,
            "time_utc": moment,
            "kind": str(line.get("kind", "")),
            "text": from_dict(line).sentence,
            "data": json.dumps(line, ensure_ascii=False, default=str),
        }

    def add_thumbnail(self, time_s: float, pattern: str, jpeg: bytes) -> None:
        """Add a picture of a camera frame.

        Parameters
        ----------
        time_s : float
            Time of the exposure, in seconds of the run.
        pattern : str
            Name of the pattern that the screen showed.
        jpeg : bytes
            The reduced picture.
        """
        number = self._next_number(table_specs.THUMBNAILS)
        row = {"number": number, "time_s": time_s, "pattern": pattern, "jpeg": jpeg}
        self._add_dicts(table_specs.THUMBNAILS, [row])

    def _next_number(self, spec: TableSpec) -> int:
        return 1 + int(max(0.0, self._open_writer(spec).until_s))

    def _add_dicts(self, spec: TableSpec, rows: list[dict[str, Any]]) -> None:
        if rows:
            columns = [
                pa.array([row[field.name] for row in rows], field.type) for field in spec.schema
            ]
            self._open_writer(spec).add_rows(pa.record_batch(columns, schema=spec.schema))

    def _open_writer(self, spec: TableSpec) -> TableWriter:
        return self._writers[spec.name]

    @property
    def open_windows(self) -> levels.OpenWindows:
        """Unfinished windows of the levels, for a successor."""
        return self._windows

    def sync_tables(self) -> None:
        """Bring all rows to the disk. Raises OSError (full disk), after all tables were tried: they
        wait.
        """
        self._for_each(TableWriter.sync_rows)

    def seal_full_journal(self) -> None:
        """Make a part of one journal that is full. Raises OSError (full disk); call again later."""
        for writer in self._writers.values():
            if writer.seal_next():
                return

    def close(self) -> None:
        """Write the open windows and end all tables. Raises OSError."""
        self._add_levels(None)
        self._add_figure_minute(self._windows.figures.end_minute())
        self._for_each(TableWriter.close)

    def leave_folder(self) -> None:
        """Continue in the folder that replaces the run's removed one."""
        for writer in self._writers.values():
            writer.leave_folder()

    def _for_each(self, action: Any) -> None:
        failure: OSError | None = None
        for writer in self._writers.values():
            try:
                action(writer)
            except OSError as error:
                failure = failure or error
        if failure is not None:
            raise failure

    @property
    def lost_rows(self) -> int:
        """Number of lost rows, over all tables."""
        return sum(writer.lost_rows for writer in self._writers.values())

    @property
    def lost_ticks(self) -> int:
        """Number of lost ticks."""
        return self._open_writer(table_specs.TICKS).lost_rows

    @property
    def part_counts(self) -> dict[str, int]:
        """Number of parts per table: if a reader finds fewer, the last ones are
        missing.
        """
        return {name: writer.part_count for name, writer in self._writers.items()}


def _tick_rows(row: Mapping[str, Column]) -> pa.RecordBatch:
    """Telemetry as the table of ticks has it: missing values null, computed numbers with seven
    digits.
    """
    arrays = []
    for field in table_specs.TICKS.schema:
        values = np.ascontiguousarray(row[field.name], dtype=np.float64)
        if COLUMNS[field.name].kind is not Kind.QUANTITY:
            arrays.append(_whole_numbers(values))
        elif table_fields.is_exact(field.name):
            # a reading that is another NaN than the missing value keeps its bits, for replays
            arrays.append(
                pa.array(values, mask=values.view(np.uint64) == _MISSING_BITS, from_pandas=False)
            )
        else:
            arrays.append(pa.array(values.astype(np.float32), mask=np.isnan(values)))
    return pa.record_batch(arrays, schema=table_specs.TICKS.schema)


def as_recorded(row: telemetry.TelemetryRow) -> telemetry.TelemetryRow:
    """A row with the values that the table of ticks has for it."""
    columns = {name: np.array([getattr(row, name)]) for name in telemetry.FIELDS}
    batch = _tick_rows(columns)
    return telemetry.TelemetryRow(
        *(float(batch.column(name).to_numpy(zero_copy_only=False)[0]) for name in telemetry.FIELDS)
    )


def _input_rows(batch: TickBatch) -> pa.RecordBatch:
    """A tick's other inputs, bit by bit."""
    values = [batch.records["tick"], *(batch.records[name] for name in table_fields.INPUT_FIELDS)]
    arrays = [pa.array(np.ascontiguousarray(column), from_pandas=False) for column in values]
    return pa.record_batch(arrays, schema=table_specs.INPUTS.schema)


def _nullable_rows(spec: TableSpec, columns: Mapping[str, Column]) -> pa.RecordBatch:
    """Columns with NaN for missing values as rows of a table."""
    arrays = []
    for field in spec.schema:
        values = np.asarray(columns[field.name], dtype=np.float64)
        if pa.types.is_integer(field.type):
            arrays.append(_whole_numbers(values))
        else:
            arrays.append(
                pa.array(values.astype(field.type.to_pandas_dtype()), mask=np.isnan(values))
            )
    return pa.record_batch(arrays, schema=spec.schema)


def _whole_numbers(values: Column) -> pa.Array:
    missing = ~np.isfinite(values)
    return pa.array(np.where(missing, 0.0, values).astype(np.int64), mask=missing)


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value
