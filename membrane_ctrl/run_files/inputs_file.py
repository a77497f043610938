"""The controller's inputs, tick by tick, for a replay (docs/how-to/replay.md)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import pyarrow as pa

from membrane_ctrl.controller.tick_codec import RECORD, SAME, Records
from membrane_ctrl.model import shape_estimate, telemetry
from membrane_ctrl.model.arrays import AnyArray
from membrane_ctrl.model.program import stated_program
from membrane_ctrl.run_files import shapes, table_fields, table_specs
from membrane_ctrl.run_files.table_store.reader import TableReader
from membrane_ctrl.run_files.table_store.spec import TableSpec

T = TypeVar("T")
# A shape is used within seconds of its exposures.
_SHAPE_BEFORE_S = 60.0
# Fields of a record that its telemetry row has as well, to the bit, and their columns there.
_ROW_COLUMNS = {name: column for name, column in SAME.items() if name not in ("now_s", "tick")}


@dataclass(frozen=True, slots=True)
class InputsFrame:
    """A part of a run: ticks by number, tails and snapshots by tick, shape estimates by time."""

    records: Records
    tails: dict[int, bytes]
    snapshots: dict[int, bytes]
    estimates: dict[float, shape_estimate.ShapeEstimate]


class InputsReader:
    """Reads the inputs of a run or an incident from its tables, a row group at a time.

    Attributes
    ----------
    damage : list of str
        Unreadable parts so far, one line per place.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._from_s = -math.inf
        self.damage: list[str] = []

    @property
    def exists(self) -> bool:
        """Whether the run has any recorded inputs."""
        return self._open_reader(table_specs.INPUTS).exists

    @property
    def program(self) -> str:
        """The program that wrote them, with its commit; empty if unknown."""
        return stated_program(self._open_reader(table_specs.INPUTS).read_metadata())

    @property
    def arithmetic(self) -> str:
        """Processor and libraries that computed the recorded outputs; empty if unknown."""
        return self._open_reader(table_specs.INPUTS).read_metadata().get("arithmetic", "")

    @property
    def columns(self) -> list[str]:
        """The columns of telemetry that the run recorded, in their order; all of today's if
        unreadable.
        """
        return self._open_reader(table_specs.TICKS).column_names() or list(telemetry.FIELDS)

    def __iter__(self) -> Iterator[InputsFrame]:
        """Yield all frames in order, each with the rare parts and shapes up to its end."""
        last = 0
        # Rare parts, snapshots and shapes are in tables of their own, in order of time.
        rare = _Ahead((row.time_s, row) for row in self._iterate_texts(table_specs.RARE))
        kept = _Ahead((row.time_s, row) for row in self._iterate_texts(table_specs.SNAPSHOTS))
        cycles = _Ahead(
            (estimate.time_s, estimate) for estimate in self._iterate_estimates(table_specs.SHAPES)
        )
        tracked = _Ahead(
            (estimate.time_s, estimate) for estimate in self._iterate_estimates(table_specs.TRACKED)
        )
        for block in self._iterate_records():
            # Ticks may be in two parts after a crash: each counts once.
            records = block[(block["tick"] > last) & (block["now_s"] >= self._from_s)]
            if not len(records):
                continue
            last = int(records["tick"][-1])
            until_s = float(records["now_s"][-1])
            tails = {row.tick: row.json.encode() for row in rare.take_until_time(until_s)}
            snapshots = {row.tick: row.json.encode() for row in kept.take_until_time(until_s)}
            estimates = [*cycles.take_until_time(until_s), *tracked.take_until_time(until_s)]
            yield InputsFrame(
                records, tails, snapshots, {found.time_s: found for found in estimates}
            )

    def start_at_snapshot(self, time_s: float) -> InputsReader:
        """A reader that starts at the last snapshot before this time of the run, or at the run's
        start.
        """
        found = InputsReader(self._folder)
        times_s = [found_s for found_s in found._snapshot_times_s() if found_s <= time_s]
        found.damage.clear()  # reported again when the table is read
        found._from_s = max(times_s, default=-math.inf)
        return found

    def _open_reader(self, spec: TableSpec) -> TableReader:
        return TableReader(self._folder, spec, self.damage)

    def _iterate_records(self) -> Iterator[Records]:
        """Records of ticks, from the table of inputs and from their telemetry rows; of ticks that
        both have.
        """
        # The same ticks are in two tables: what went in, and the row that came out.
        rows = _TickRows(
            self._open_reader(table_specs.TICKS).iterate_tables(
                ["tick", *_ROW_COLUMNS.values()], self._from_s
            )
        )
        names = table_specs.INPUTS.schema.names
        for inputs in self._open_reader(table_specs.INPUTS).iterate_tables(names, self._from_s):
            if inputs.column_names != names:
                continue
            numbers = _record_column(inputs, "tick")
            same = rows.take_until_tick(int(numbers.max()))
            if same is None:
                continue
            _, here, there = np.intersect1d(
                numbers, _record_column(same, "tick"), return_indices=True
            )
            # Their columns, side by side.
            records = np.zeros(here.size, dtype=RECORD)
            records["tick"] = numbers[here]
            for name in table_fields.INPUT_FIELDS:
                records[name] = _record_column(inputs, "time_s" if name == "now_s" else name)[here]
            for name, column in _ROW_COLUMNS.items():
                records[name] = _record_column(same, column)[there]
            yield records

    def _iterate_texts(self, spec: TableSpec) -> Iterator[_TextRow]:
        names = spec.schema.names
        for table in self._open_reader(spec).iterate_tables(names, self._from_s):
            if table.column_names == names:
                rows = zip(*(table.column(name).to_pylist() for name in names), strict=True)
                yield from (_TextRow(*values) for values in rows if None not in values)

    def _snapshot_times_s(self) -> Iterator[float]:
        for table in self._open_reader(table_specs.SNAPSHOTS).iterate_tables(["time_s"]):
            yield from _record_column(table, "time_s").tolist()

    def _iterate_estimates(self, spec: TableSpec) -> Iterator[shape_estimate.ShapeEstimate]:
        names = list(shapes.ESTIMATE_COLUMNS)
        for table in self._open_reader(spec).iterate_tables(names, self._from_s - _SHAPE_BEFORE_S):
            try:
                yield from shapes.read_estimates(table.select(names))
            except (ValueError, LookupError) as error:
                self.damage.append(f"{spec.name}: a row group holds no estimates ({error})")


def _record_column(table: pa.Table, name: str) -> AnyArray:
    """A column as it goes into a record: integers as such, missing readings as NaN."""
    column = table.column(name).combine_chunks()
    if pa.types.is_integer(column.type):
        return np.asarray(column.fill_null(0).to_numpy(zero_copy_only=False))
    return np.asarray(column.to_numpy(zero_copy_only=False))


class _TickRows:
    """Telemetry rows in order of their ticks, handed out up to a given tick."""

    def __init__(self, tables: Iterator[pa.Table]) -> None:
        self._tables = tables
        self._waiting: pa.Table | None = None

    def take_until_tick(self, tick: int) -> pa.Table | None:
        """The rows up to a tick that were not handed out before; None without any."""
        # Read on until the tick is there, hand out what is up to it, and keep the rest
        parts = [] if self._waiting is None else [self._waiting]
        while not parts or int(_record_column(parts[-1], "tick")[-1]) < tick:
            table = next(self._tables, None)
            if table is None:
                break
            if table.num_rows and table.num_columns == 1 + len(_ROW_COLUMNS):
                parts.append(table)
        if not parts:
            return None
        joined = pa.concat_tables(parts)
        count = int(np.searchsorted(_record_column(joined, "tick"), tick, side="right"))
        if count < joined.num_rows:
            self._waiting = joined.slice(count)
        else:
            self._waiting = None
        return joined.slice(0, count)


@dataclass(frozen=True, slots=True)
class _TextRow:
    """A row of the table of rare inputs or of snapshots."""

    time_s: float
    tick: int
    json: str


class _Ahead(Generic[T]):
    """Items in order of time, handed out up to a given time."""

    def __init__(self, timed: Iterator[tuple[float, T]]) -> None:
        self._timed = timed
        self._next = next(timed, None)

    def take_until_time(self, time_s: float) -> Iterator[T]:
        """The items up to a time that were not handed out before."""
        while self._next is not None and self._next[0] <= time_s:
            yield self._next[1]
            self._next = next(self._timed, None)
