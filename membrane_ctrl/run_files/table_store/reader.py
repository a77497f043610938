"""Reads a table of a run: its parts and the journal of its newest rows, in order and each row once.

Memory is bounded by a row group. Damage is noted, and everything else is read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from membrane_ctrl.model.files import read_bytes
from membrane_ctrl.run_files.table_store import journal, spec
from membrane_ctrl.run_files.table_store.manifest import PartEntry, read_manifest
from membrane_ctrl.run_files.table_store.part_reader import LostGroup, PartError, PartReader
from membrane_ctrl.run_files.table_store.sealing import describe_lost_bytes
from membrane_ctrl.run_files.table_store.spec import TableSpec

_NUMBERS_MAX = 100_000  # ten years of hours
_FAULTS = (pa.ArrowException, OSError, ValueError)


class TableReader:
    """A table of a run, opened for reading.

    Parameters
    ----------
    run_dir : Path
        Folder of the run, which may be in progress, or come from elsewhere.
    table : TableSpec
        Columns of another type than here are not read.
    notes : list of str
        Gets a line for each damaged or missing piece.
    """

    def __init__(self, run_dir: Path, table: TableSpec, notes: list[str]) -> None:
        self._folder = run_dir / table.name
        self._table = table
        self._notes = notes
        damage: list[str] = []
        self._entries = read_manifest(self._folder, damage)
        notes += [line for line in damage if line not in notes]
        found = {
            n for path in self._folder.glob("*-*") if (n := spec.file_number(path)) is not None
        }
        self.numbers = sorted(found | set(self._entries))[:_NUMBERS_MAX]
        for entry in self._entries.values():
            for text in entry.damage:
                self._note_damage(self._read_part(entry.number), f"its journal was damaged, {text}")

    @property
    def exists(self) -> bool:
        """Whether the run has any file of the table."""
        return bool(self.numbers)

    @property
    def known_until_s(self) -> float:
        """Time of the last row of the last part in the manifest; -inf without one."""
        return max((entry.last_s for entry in self._entries.values()), default=-math.inf)

    def note_missing(self, count: int = 0) -> None:
        """Note the parts that are missing, of `count` known ones."""
        highest = max(self.numbers, default=-1)
        for number in range(max(count, highest + 1)):
            if not self._read_part(number).exists() and not self._read_journal(number).exists():
                entry = self._entries.get(number)
                rows = "its rows are"
                if entry:
                    rows = f"rows from {entry.first_s:.2f} s to {entry.last_s:.2f} s are"
                self._note_damage(self._read_part(number), f"missing; {rows} left out")

    def iterate_tables(
        self,
        names: Sequence[str] | None = None,
        start_s: float = -math.inf,
        end_s: float = math.inf,
    ) -> Iterator[pa.Table]:
        """Rows from `start_s` up to `end_s`, a row group at a time.

        Parameters
        ----------
        names : sequence of str, optional
            Columns, all by default; those that a file lacks are left out of its tables.
        start_s, end_s : float
            Part of the run by the table's time column; the end does not belong to it.
        """
        wanted = tuple(self._table.schema.names if names is None else names)
        with_time = tuple(dict.fromkeys((*wanted, self._table.time_name)))
        for number in self.numbers:
            entry = self._entries.get(number)
            if entry is not None and (entry.last_s < start_s or entry.first_s >= end_s):
                continue
            for table in self._file_tables(number, entry, with_time, start_s, end_s):
                rows = self._select_between(table, start_s, end_s)
                if rows.num_rows:
                    yield rows.select([name for name in wanted if name in rows.column_names])

    def read_newest(self, name: str) -> pa.Scalar | None:
        """A column's value in the last readable row; None without one."""
        for number in reversed(self.numbers):
            found = list(
                self._file_tables(number, self._entries.get(number), (name,), -math.inf, math.inf)
            )
            if found and found[-1].num_rows:
                return found[-1].column(name)[-1]
        return None

    def read_metadata(self) -> dict[str, str]:
        """The table's own metadata, as in its first readable file: schema, program, commit."""
        for number in self.numbers:
            schema = self._schema_of(number)
            if schema is not None:
                pairs = (schema.metadata or {}).items()
                return {
                    key.decode(errors="replace"): text.decode(errors="replace")
                    for key, text in pairs
                }
        return {}

    def column_names(self) -> list[str]:
        """The columns of the table, as in its first readable file; empty without one."""
        return next(
            (schema.names for schema in map(self._schema_of, self.numbers) if schema is not None),
            [],
        )

    def _schema_of(self, number: int) -> pa.Schema | None:
        try:
            if self._read_part(number).exists():
                with PartReader(self._read_part(number), self._entries.get(number)) as part:
                    return part.schema
            frames = journal.find_frames(
                read_bytes(self._read_journal(number), journal.FILE_BYTES_MAX)
            )
            if frames and not frames[0].rows:
                return journal.read_schema(frames[0])
            return None
        except _FAULTS:
            return None

    def check_all(self) -> None:
        """Compare every part with its SHA-256, and note those that differ."""
        for number, entry in self._entries.items():
            path = self._read_part(number)
            try:
                with PartReader(path, entry) as part:
                    if not part.is_unchanged():
                        self._note_damage(
                            path, "its SHA-256 is not that of the manifest: damaged or changed"
                        )
            except FileNotFoundError:
                continue
            except _FAULTS as error:
                self._note_damage(path, f"cannot be read ({_describe_reason(error)})")

    def _file_tables(
        self,
        number: int,
        entry: PartEntry | None,
        names: Sequence[str],
        start_s: float,
        end_s: float,
    ) -> Iterator[pa.Table]:
        """Tables of a part, or of its journal if there is no part yet."""
        if self._read_part(number).exists():
            yield from self._part_tables(number, entry, names, start_s, end_s)
            return
        path = self._read_journal(number)
        try:
            data = read_bytes(path, journal.FILE_BYTES_MAX)
        except FileNotFoundError:  # sealed in the meantime, or missing
            yield from self._part_tables(
                number, read_manifest(self._folder, []).get(number), names, start_s, end_s
            )
            return
        except OSError as error:
            self._note_damage(path, f"cannot be read ({error.strerror})")
            return
        yield from self._journal_tables(path, data, names)

    def _part_tables(
        self,
        number: int,
        entry: PartEntry | None,
        names: Sequence[str],
        start_s: float,
        end_s: float,
    ) -> Iterator[pa.Table]:
        """Yield the row groups of a part that may have rows of the time; notes what is lost."""
        path = self._read_part(number)
        try:
            with PartReader(path, entry) as part:
                known = self._select_known(path, part.schema, names)
                for text in part.notes:
                    self._note_damage(path, text)
                for group in part.iterate_groups(known, start_s, end_s) if known else ():
                    if isinstance(group, LostGroup):
                        self._note_damage(path, f"{_span_of(group)} left out ({group.why})")
                    else:
                        yield group
        except FileNotFoundError:
            return  # `note_missing` reports it
        except _FAULTS as error:
            self._note_damage(path, f"cannot be read ({_describe_reason(error)})")

    def _journal_tables(self, path: Path, data: bytes, names: Sequence[str]) -> Iterator[pa.Table]:
        try:
            for block in journal.read_journal(data, self._table.group_rows, self._table.schema):
                if isinstance(block, journal.LostBytes):
                    self._note_damage(path, describe_lost_bytes(block))
                    continue
                known = self._select_known(path, block.table.schema, names)
                if known:
                    yield block.table.select(known)
        except _FAULTS as error:
            self._note_damage(path, f"cannot be read ({_describe_reason(error)})")

    def _select_known(self, path: Path, schema: pa.Schema, names: Sequence[str]) -> list[str]:
        """The columns of a file that are what a recorder writes under their names.

        None without the time, or if the file states another layout.
        """
        if (other := self._other_layout(schema)) is not None:
            self._note_damage(path, other)
            return []
        known = [name for name in names if self._is_ours(schema, name)]
        absent = sorted(set(names) - set(known))
        if absent:
            self._note_damage(path, f"without {', '.join(absent)}")
        if self._table.time_name in known or self._table.time_name not in names:
            return known
        return []

    def _other_layout(self, schema: pa.Schema) -> str | None:
        """How a file's layout differs from the program's; None if it does not, or states none."""
        stated = schema.metadata or {}
        for name, own in self._table.layout:
            found = stated.get(name.encode(), own.encode()).decode(errors="replace")[:20]
            if found != own:
                return (
                    f"written with {name.replace('_', ' ')} = {found}, this program has {own}: "
                    "left out"
                )
        return None

    def _is_ours(self, schema: pa.Schema, name: str) -> bool:
        places = schema.get_all_field_indices(name)
        if len(places) != 1 or name not in self._table.schema.names:
            return False
        kind = schema.field(places[0]).type
        if pa.types.is_dictionary(kind):
            kind = kind.value_type
        return bool(kind == self._table.schema.field(name).type)

    def _select_between(self, table: pa.Table, start_s: float, end_s: float) -> pa.Table:
        if start_s == -math.inf and end_s == math.inf:
            return table
        time_s = table.column(self._table.time_name).to_numpy()
        first, last = np.searchsorted(time_s, [start_s, end_s])
        return table.slice(first, max(0, last - first))

    def _read_part(self, number: int) -> Path:
        return spec.part_path(self._folder, number)

    def _read_journal(self, number: int) -> Path:
        return spec.journal_path(self._folder, number)

    def _note_damage(self, path: Path, text: str) -> None:
        line = f"{path.parent.name}/{path.name}: {text}"
        if line not in self._notes:
            self._notes.append(line)


def _span_of(lost: LostGroup) -> str:
    if lost.first_s is None or lost.last_s is None:
        return "rows are"
    return f"rows from {lost.first_s:.2f} s to {lost.last_s:.2f} s are"


def _describe_reason(error: BaseException) -> str:
    if isinstance(error, PartError):
        return str(error)
    return (
        getattr(error, "strerror", None)
        or (str(error).splitlines() or [type(error).__name__])[0][:120]
    )
