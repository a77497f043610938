"""Reads the tables beside a recording (`recording.column_file`); what is damaged is said, the rest is given."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from membrane_ctrl.recording.column_file import FOLDER, SUFFIX
from membrane_ctrl.recording.sealed_stream import Damage, Unsealed, unseal
from membrane_ctrl.review.possible_times import possible_times

# The column that says when: of ticks, and of the other tables.
_TIMES = ("mono_s", "time_s")
_LOOK_BYTES = 1 << 20  # holds the head and a first batch


def column_files(folder: Path, table: str) -> list[Path]:
    """The files of a table in their order."""
    return sorted((folder / FOLDER).glob(f"{table}-*{SUFFIX}"))


def missing_files(files: Sequence[Path], first: str, count: int = 0) -> list[str]:
    """Names of files that are not there, of a table or recording whose files are numbered.

    Parameters
    ----------
    files : sequence of Path
        Those that are there.
    first : str
        Name of file 0: `ticks-000.arrows`.
    count : int
        How many there should be, where that is known.
    """
    pattern = re.fullmatch(r"(.*-)(\d+)(\.\w+)", first)
    if pattern is None:  # somebody's own file
        return []
    stem, number, suffix = pattern.groups()
    there = {int(found[1]) for path in files if (found := re.search(r"-(\d+)\.\w+$", path.name))}
    every = range(max(max(there, default=-1) + 1, count))
    return [f"{stem}{n:0{len(number)}d}{suffix}" for n in every if n not in there]


def read_file(path: Path, names: Sequence[str] | None, notes: list[str], over: bool = False) -> pa.Table | None:
    """One file's columns; None if nothing of it can be read.

    Parameters
    ----------
    path : Path
        An Arrow stream.
    names : sequence of str or None
        Columns wanted (those that the file does not have are left out); None: all.
    notes : list
        Gets a line for a file that is damaged, or of a version without a wanted column.
    over : bool
        The file should have an end: it is its table's last one, and the run was closed.
    """
    try:
        # a plain read: the pages of a mapped file would count as ours
        content = unseal(path.read_bytes())
        if not content.data:
            add_note(notes, f"{path.name}: cannot be read ({'its head is damaged' if content.damage else 'empty'})")
            return None
        return _read(path, content, names, notes, over)
    except (pa.ArrowException, OSError) as error:
        add_note(notes, f"{path.name}: cannot be read ({_first_line(error)})")
        return None


def _read(
    path: Path, content: Unsealed, names: Sequence[str] | None, notes: list[str], over: bool
) -> pa.Table | None:
    schema = pa.ipc.open_stream(content.data).schema
    wanted = schema.names if names is None else [name for name in names if name in schema.names]
    absent = sorted(set(names or ()) - set(wanted))
    if absent:
        add_note(notes, f"{path.name}: written by another version, without {', '.join(absent)}")
    if not wanted:
        return None
    # one thread: buffers of a minute are too small to hand around
    options = pa.ipc.IpcReadOptions(included_fields=[schema.names.index(n) for n in wanted], use_threads=False)
    reader = pa.ipc.open_stream(content.data, options=options)
    batches, error = _batches(reader)
    if error is not None:
        add_note(notes, f"{path.name}: damaged or cut short behind batch {len(batches)} ({_first_line(error)})")
    if not content.sealed:
        add_note(notes, "tables without checksums, of an earlier version: a flipped byte in them would not be seen")
    for damage in content.damage:
        size_kb = damage.size_bytes / 1e3
        what = "cut short" if damage.at_end and not content.ended else "damaged"
        add_note(notes, f"{path.name}: {what}, {size_kb:.1f} kB: {_rows_lost(batches, damage)} left out")
    if content.sealed and over and not content.ended and not content.damage:
        lost = _rows_lost(batches, Damage(len(batches), 0, True))
        add_note(notes, f"{path.name}: without the mark of its end: {lost} missing, if there were any")
    table = pa.Table.from_batches(batches, schema=reader.schema).select(wanted)
    return table if content.sealed else _possible(path, table, notes)


def _possible(path: Path, table: pa.Table, notes: list[str]) -> pa.Table:
    """Rows whose time can be: without a checksum it may be any number."""
    name = next((name for name in _TIMES if name in table.schema.names), None)
    if name is None:
        return table
    mask = possible_times(table.column(name).to_numpy())
    if not mask.all():
        add_note(notes, f"{path.name}: {np.count_nonzero(~mask)} rows with impossible times are left out")
    return table.filter(pa.array(mask))


def first_s(path: Path, time_name: str) -> float | None:
    """Time of the first row; None if the file's beginning does not give it."""
    times_s = first_column(path, time_name)
    return float(times_s[0]) if times_s.size else None


def first_column(path: Path, name: str) -> NDArray[np.float64]:
    """A column of the first batch; empty if the file's beginning does not give it."""
    try:
        with path.open("rb") as file:
            content = unseal(file.read(_LOOK_BYTES))
        batch = pa.ipc.open_stream(content.data).read_next_batch()
        return np.asarray(batch.column(name).to_numpy(zero_copy_only=False), dtype=np.float64)
    except (pa.ArrowException, OSError, KeyError, StopIteration):
        return np.empty(0)


def _batches(reader: pa.RecordBatchReader) -> tuple[list[pa.RecordBatch], Exception | None]:
    """All batches up to the one that cannot be read, and why it cannot."""
    found: list[pa.RecordBatch] = []
    try:
        found.extend(iter(reader))
    except (pa.ArrowException, OSError) as error:
        return found, error
    return found, None


def _rows_lost(batches: Sequence[pa.RecordBatch], damage: Damage) -> str:
    """The rows that a stretch has held, by the times of those around it."""
    after = damage.batches
    last_s = _time_s(batches[after - 1], -1) if 0 < after <= len(batches) else None
    next_s = _time_s(batches[after], 0) if after < len(batches) else None
    if last_s is not None and next_s is not None:
        return f"rows between {last_s:.2f} s and {next_s:.2f} s are"
    if last_s is not None:
        return f"rows behind {last_s:.2f} s are"
    return "all rows are" if next_s is None else f"rows before {next_s:.2f} s are"


def _time_s(batch: pa.RecordBatch, row: int) -> float | None:
    name = next((name for name in _TIMES if name in batch.schema.names), None)
    return None if name is None or not batch.num_rows else float(batch.column(name)[row].as_py())


def add_note(notes: list[str], text: str) -> None:
    """A line, once."""
    if text not in notes:
        notes.append(text)


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]
