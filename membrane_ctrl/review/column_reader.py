"""Reads the tables beside a recording (`recording.column_file`); what is damaged is said, the rest is given."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import pyarrow as pa

from membrane_ctrl.recording.column_file import FOLDER, SUFFIX


def column_files(folder: Path, table: str) -> list[Path]:
    """The files of a table in their order."""
    return sorted((folder / FOLDER).glob(f"{table}-*{SUFFIX}"))


def missing_files(files: Sequence[Path]) -> list[str]:
    """Names of files that the numbering says were there."""
    numbers = {int(found[1]): path for path in files if (found := re.search(r"-(\d+)\.\w+$", path.name))}
    if not numbers:
        return []
    pattern = next(iter(numbers.values()))
    stem, width = pattern.stem.rsplit("-", 1)[0], len(pattern.stem.rsplit("-", 1)[1])
    return [f"{stem}-{n:0{width}d}{pattern.suffix}" for n in range(max(numbers)) if n not in numbers]


def read_file(path: Path, names: Sequence[str] | None, notes: list[str]) -> pa.Table | None:
    """One file's columns; None if nothing of it can be read.

    Parameters
    ----------
    path : Path
        An Arrow stream.
    names : sequence of str or None
        Columns wanted (those that the file does not have are left out); None: all.
    notes : list
        Gets a line for a file that is damaged, or of a version without a wanted column.
    """
    try:
        # a plain file: the pages of a mapped one would count as ours
        with pa.OSFile(str(path)) as source:
            schema = pa.ipc.open_stream(source).schema
            wanted = schema.names if names is None else [name for name in names if name in schema.names]
            absent = sorted(set(names or ()) - set(wanted))
            if absent:
                _note(notes, f"{path.name}: written by another version, without {', '.join(absent)}")
            if not wanted:
                return None
            source.seek(0)
            fields = [schema.names.index(name) for name in wanted]
            # one thread: buffers of a minute are too small to hand around
            options = pa.ipc.IpcReadOptions(included_fields=fields, use_threads=False)
            try:
                return pa.ipc.open_stream(source, options=options).read_all().select(wanted)
            except (pa.ArrowException, OSError):
                source.seek(0)
            reader = pa.ipc.open_stream(source, options=options)
            return pa.Table.from_batches(list(_batches(reader, path, notes)), schema=reader.schema).select(wanted)
    except (pa.ArrowException, OSError) as error:
        _note(notes, f"{path.name}: cannot be read ({_first_line(error)})")
        return None


def first_s(path: Path, time_name: str) -> float | None:
    """Time of the first row; None if the file does not give it."""
    try:
        with pa.OSFile(str(path)) as source:
            return float(pa.ipc.open_stream(source).read_next_batch().column(time_name)[0].as_py())
    except (pa.ArrowException, OSError, KeyError, StopIteration):
        return None


def _batches(reader: pa.RecordBatchReader, path: Path, notes: list[str]) -> Iterator[pa.RecordBatch]:
    number = 0
    while True:
        try:
            batch = reader.read_next_batch()
        except StopIteration:
            return
        except (pa.ArrowException, OSError) as error:
            _note(notes, f"{path.name}: damaged or cut short behind batch {number} ({_first_line(error)})")
            return
        number += 1
        yield batch


def _note(notes: list[str], text: str) -> None:
    if text not in notes:
        notes.append(text)


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]
