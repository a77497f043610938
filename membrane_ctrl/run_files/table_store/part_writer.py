"""Writes a finished part: one Parquet file, complete and on the disk before it has its name."""

import hashlib
import io
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from membrane_ctrl.run_files.table_store.disk import Disk
from membrane_ctrl.run_files.table_store.manifest import GroupEntry, PartEntry, pack_footer

MAGIC = b"PAR1"
TAIL_BYTES = 8  # length of the footer, and the magic
FIRST_ROW = b"first_row"  # in the file's metadata
# Level 9 saves 2 % over level 3.
_ZSTD_LEVEL = 9
_TRIAL_LEVEL = 1
# Rows on which the encoding of a column is tried.
_TRIAL_ROWS = 8_000
_DICTIONARY = "dictionary"


def write_part(
    disk: Disk, path: Path, number: int, first_row: int, groups: Iterable[pa.Table], time_name: str
) -> PartEntry | None:
    """Write a part under another name, sync it and rename it.

    Parameters
    ----------
    disk : Disk
        The system calls.
    path : Path
        The final name.
    number : int
        Of the part, for its line in the manifest.
    first_row : int
        Number of the part's first row in its table.
    groups : iterable of pyarrow.Table
        The row groups, in order.
    time_name : str
        The column of times.

    Returns
    -------
    PartEntry or None
        The manifest's line; None if there are no rows, and no file.

    Raises
    ------
    OSError
        The disk is full; a file of that name is then as before.
    """
    scratch = path.with_name(f".{path.name}.part")
    disk.remove(scratch)
    file = _HashedFile(disk, disk.create(scratch))
    try:
        times_s = _write_groups(file, first_row, groups, time_name)
        disk.sync(file.descriptor)
        entry = None
        if times_s:
            entry = _make_entry(scratch, number, first_row, file, times_s)
    except Exception:
        disk.remove(scratch)
        raise
    finally:
        disk.close(file.descriptor)
    if entry is None:
        disk.remove(scratch)
        return None
    disk.rename(scratch, path)
    disk.sync_folder(path.parent)
    return entry


class _HashedFile(io.RawIOBase):
    """What Arrow writes to: a file with the size and the SHA-256 of its content. Closing it leaves
    the file open.
    """

    def __init__(self, disk: Disk, descriptor: int) -> None:
        super().__init__()
        self._disk = disk
        self.descriptor = descriptor
        self.size_bytes = 0
        self.sha256 = hashlib.sha256()

    def writable(self) -> bool:
        return True

    def tell(self) -> int:
        return self.size_bytes

    def write(self, data: Any) -> int:
        content = bytes(data)
        self._disk.write(self.descriptor, content)
        self.sha256.update(content)
        self.size_bytes += len(content)
        return len(content)


def _write_groups(
    file: _HashedFile, first_row: int, groups: Iterable[pa.Table], time_name: str
) -> list[tuple[float, float]]:
    """Write the row groups; returns the times of their first and last rows."""
    times_s: list[tuple[float, float]] = []
    writer: pq.ParquetWriter | None = None
    for group in groups:
        if writer is None:
            about = {**(group.schema.metadata or {}), FIRST_ROW: str(first_row)}
            writer = _new_writer(file, group.schema.with_metadata(about), group, time_name)
        writer.write_table(group.replace_schema_metadata(about), row_group_size=group.num_rows)
        time_s = group.column(time_name)
        times_s.append((float(time_s[0].as_py()), float(time_s[-1].as_py())))
    if writer is not None:
        writer.close()
    return times_s


def _new_writer(
    file: _HashedFile, schema: pa.Schema, first_group: pa.Table, time_name: str
) -> pq.ParquetWriter:
    """A Parquet writer whose encodings suit the first row group."""
    encodings = dict(_choose_encodings(first_group.slice(0, _TRIAL_ROWS)))
    dictionaries = [path for path, encoding in encodings.items() if encoding == _DICTIONARY]
    others = {path: encoding for path, encoding in encodings.items() if encoding != _DICTIONARY}
    return pq.ParquetWriter(
        file,
        schema,
        compression="zstd",
        compression_level=_ZSTD_LEVEL,
        use_dictionary=dictionaries or False,
        column_encoding=others or None,
        write_page_checksum=True,
        write_statistics=[time_name],
    )


def _choose_encodings(rows: pa.Table) -> Iterator[tuple[str, str]]:
    """The smallest encoding of each column, by its path in Parquet."""
    for field in rows.schema:
        values = rows.column(field.name)
        kind, path = field.type, field.name
        if isinstance(kind, pa.FixedSizeListType | pa.ListType):
            kind, path = kind.value_type, f"{field.name}.list.element"
        if pa.types.is_boolean(kind) or pa.types.is_binary(kind):
            yield path, "PLAIN"
        elif pa.types.is_string(kind):
            yield path, _DICTIONARY
        else:
            yield (
                path,
                min(
                    _list_candidates(kind),
                    key=lambda encoding: _trial_bytes(values, path, encoding),
                ),
            )


def _list_candidates(kind: pa.DataType) -> list[str]:
    """Encodings worth a trial: readings are short decimals, computed numbers are not."""
    if pa.types.is_floating(kind):
        return ["BYTE_STREAM_SPLIT", "PLAIN", _DICTIONARY]
    if pa.types.is_timestamp(kind) or kind.bit_width >= 32:
        return ["DELTA_BINARY_PACKED", "PLAIN", _DICTIONARY]
    return ["PLAIN", _DICTIONARY]


def _trial_bytes(values: pa.ChunkedArray, path: str, encoding: str) -> int:
    """Size of some rows of a column in an encoding, packed quickly."""
    table = pa.table([values], names=[path.partition(".")[0]])
    sink = pa.BufferOutputStream()
    options: dict[str, Any] = {"use_dictionary": True}
    if encoding != _DICTIONARY:
        options = {"use_dictionary": False, "column_encoding": {path: encoding}}
    pq.write_table(
        table,
        sink,
        compression="zstd",
        compression_level=_TRIAL_LEVEL,
        write_statistics=False,
        **options,
    )
    return int(sink.getvalue().size)


def _make_entry(
    path: Path, number: int, first_row: int, file: _HashedFile, times_s: list[tuple[float, float]]
) -> PartEntry:
    """The manifest's line for a file just written."""
    with path.open("rb") as written:
        # A checksum of each column's bytes in each row group
        metadata = pq.read_metadata(written)
        groups = []
        for place, (first_s, last_s) in enumerate(times_s):
            group = metadata.row_group(place)
            spans = [chunk_span(group.column(column)) for column in range(group.num_columns)]
            checksums = []
            for start, size in spans:
                written.seek(start)
                checksums.append(zlib.crc32(written.read(size)))
            groups.append(GroupEntry(first_s=first_s, last_s=last_s, crc32=tuple(checksums)))
        # A copy of the footer, without which no reader finds the columns; its length stands at the
        # end
        written.seek(file.size_bytes - TAIL_BYTES)
        footer_bytes = int.from_bytes(written.read(4), "little")
        written.seek(file.size_bytes - TAIL_BYTES - footer_bytes)
        footer = written.read(footer_bytes)
    return PartEntry(
        number=number,
        first_row=first_row,
        rows=metadata.num_rows,
        size_bytes=file.size_bytes,
        sha256=file.sha256.hexdigest(),
        footer=pack_footer(footer),
        groups=tuple(groups),
    )


def chunk_span(chunk: pq.ColumnChunkMetaData) -> tuple[int, int]:
    """Place and size of a column chunk in its file."""
    starts = [chunk.data_page_offset]
    if chunk.has_dictionary_page and chunk.dictionary_page_offset:
        starts.append(chunk.dictionary_page_offset)
    return min(starts), chunk.total_compressed_size
