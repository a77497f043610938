"""The controller's inputs, tick by tick, for a replay (docs/replay.md)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from membrane_ctrl.controller.tick import RECORD, Records
from membrane_ctrl.model import shape_estimate
from membrane_ctrl.run_files import column_reader, shapes, tables

T = TypeVar("T")
# A shape is used within seconds of its exposures.
_SHAPE_BEFORE_S = 60.0


@dataclass(frozen=True, slots=True)
class InputsFrame:
    """A part of a run: ticks by number, tails and memories by tick, shape estimates by time."""

    records: Records
    tails: dict[int, bytes]
    memories: dict[int, bytes]
    estimates: dict[float, shape_estimate.ShapeEstimate]


class InputsReader:
    """Reads the inputs of a run or an incident from the tables `ticks`, `rare` and `shapes`, batch by batch.

    Damage is listed, not raised.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._from_s = -math.inf
        self.paths = column_reader.column_files(folder, tables.TICKS)
        self.program = ""  # that wrote the last file read
        self.damage: list[str] = []  # unreadable parts so far, one line per place

    def __iter__(self) -> Iterator[InputsFrame]:
        """Yield all frames in order, each with the rare parts and shapes up to its end."""
        last = 0
        rare = _Ahead((row.time_s, row) for row in self._rare())
        figures = _Ahead((estimate.time_s, estimate) for estimate in self._estimates())
        for table in self._tables(tables.TICKS, tuple(tables.GIVEN.values())):
            records = self._records(table)
            records = records[(records["tick"] > last) & (records["now_s"] >= self._from_s)]
            if not len(records):
                continue
            last, until_s = int(records["tick"][-1]), float(records["now_s"][-1])
            parts = list(rare.until(until_s))
            tails = {row.tick: row.data for row in parts if row.kind == tables.COMMANDS}
            memories = {row.tick: row.data for row in parts if row.kind == tables.MEMORY}
            yield InputsFrame(records, tails, memories, {found.time_s: found for found in figures.until(until_s)})

    def since(self, time_s: float) -> InputsReader:
        """A reader that starts at the last memory before this time of the run."""
        found = InputsReader(self._folder)
        times_s = [row.time_s for row in found._rare() if row.kind == tables.MEMORY and row.time_s <= time_s]
        found.damage.clear()  # reported again when the file is read
        found._from_s = max(times_s, default=-math.inf)
        return found

    def _tables(self, table: str, names: Sequence[str], before_s: float = 0.0) -> Iterator[pa.Table]:
        """A table's batches, without files that end before the reader starts."""
        paths = column_reader.column_files(self._folder, table)
        begin_s = self._from_s - before_s
        time_name = "mono_s" if table == tables.TICKS else "time_s"
        for place, path in enumerate(paths):
            if math.isfinite(begin_s) and place + 1 < len(paths):
                next_s = column_reader.first_s(paths[place + 1], time_name)
                if next_s is not None and next_s < begin_s:
                    continue
            if table == tables.TICKS:
                self.program = column_reader.written_by(path) or self.program
            yield from column_reader.read_parts(path, names, self.damage, cells=0)

    def _records(self, table: pa.Table) -> Records:
        """The records of a batch; none if a field is missing."""
        if not set(tables.GIVEN.values()) <= set(table.column_names):
            return np.zeros(0, dtype=RECORD)
        records = np.zeros(table.num_rows, dtype=RECORD)
        for name, column in tables.GIVEN.items():
            with np.errstate(invalid="ignore"):
                records[name] = table.column(column).to_numpy()
        return records

    def _rare(self) -> Iterator[_Rare]:
        for table in self._tables(tables.RARE, tables.rare_schema().names):
            if table.column_names == tables.rare_schema().names:
                rows = zip(*(table.column(name).to_pylist() for name in table.column_names), strict=True)
                yield from (row for row in (_Rare(*values) for values in rows) if row.time_s >= self._from_s)

    def _estimates(self) -> Iterator[shape_estimate.ShapeEstimate]:
        for table in self._tables(tables.SHAPES, shapes.ESTIMATE_COLUMNS, _SHAPE_BEFORE_S):
            try:
                yield from shapes.estimates(table.filter(pc.field("time_s") >= self._from_s - _SHAPE_BEFORE_S))
            except (ValueError, LookupError) as error:
                column_reader.add_note(self.damage, f"{tables.SHAPES}: a batch holds no estimates ({error})")


@dataclass(frozen=True, slots=True)
class _Rare:
    """A row of the table `rare`."""

    time_s: float
    tick: int
    kind: str
    data: bytes


class _Ahead(Generic[T]):
    """Items in order of time, handed out up to a given time."""

    def __init__(self, timed: Iterator[tuple[float, T]]) -> None:
        self._timed = timed
        self._next = next(timed, None)

    def until(self, time_s: float) -> Iterator[T]:
        """The items up to a time that were not handed out before."""
        while self._next is not None and self._next[0] <= time_s:
            yield self._next[1]
            self._next = next(self._timed, None)
