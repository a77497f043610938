"""Reads a finished part, column by column of each row group, whatever program wrote it.

Nothing is decoded on trust: the footer is compared with the manifest's copy, the sizes of pages are
added up before Arrow takes memory for them, and each column is checked against its checksum. A
damaged column costs its row group.
"""

from __future__ import annotations

import hashlib
import os
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from membrane_ctrl.model.files import open_plain
from membrane_ctrl.run_files.table_store import page_headers
from membrane_ctrl.run_files.table_store.manifest import FOOTER_BYTES_MAX, PartEntry, unpack_footer
from membrane_ctrl.run_files.table_store.part_writer import FIRST_ROW, MAGIC, TAIL_BYTES, chunk_span

# An hour at 200 Hz is 40 MB, an hour of thumbnails 9 MB.
PART_BYTES_MAX = 400_000_000
# A row group of 30 000 ticks with 60 columns is 15 MB, one of 3000 covariances 16 MB.
CHUNK_BYTES_MAX = 60_000_000
GROUP_BYTES_MAX = 120_000_000
GROUP_ROWS_MAX = 1_000_000
GROUPS_MAX = 10_000
_THRIFT_ITEMS_MAX = 1_000_000
_HASH_BYTES = 1 << 20
_VALUE_BYTES = 8  # of a number in memory, at most
_FAULTS = (pa.ArrowException, OSError, ValueError)


class PartError(ValueError):
    """A part that cannot be read at all; the message states why."""


@dataclass(frozen=True, slots=True)
class LostGroup:
    """A row group that cannot be read, and why; times are None if unknown."""

    first_s: float | None
    last_s: float | None
    why: str


class PartReader:
    """An open part; use it as a context manager. `entry` is the manifest's line, None if it is
    lost.

    Raises OSError or PartError.
    """

    def __init__(self, path: Path, entry: PartEntry | None) -> None:
        self._path = path
        self._entry = entry
        self.notes: list[str] = []
        self._file = open_plain(path)
        try:
            self._size_bytes = os.fstat(self._file.fileno()).st_size
            if self._size_bytes > PART_BYTES_MAX:
                raise PartError(f"{self._size_bytes / 1e6:.0f} MB, which no recorder writes")
            self._parquet = self._open_with_footer(self._read_footer())
        except _FAULTS as error:
            self._file.close()
            raise error if isinstance(error, PartError) else PartError(_first_line(error)) from None
        self.schema: pa.Schema = self._parquet.schema_arrow
        if self._parquet.metadata.num_row_groups > GROUPS_MAX:
            self._file.close()
            raise PartError("more row groups than a recorder writes")

    def __enter__(self) -> PartReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def first_row(self) -> int:
        """Number of the first row in the table; 0 if the file does not state it."""
        text = (self.schema.metadata or {}).get(FIRST_ROW, b"0")
        if text.isdigit() and len(text) < 18:
            return int(text)
        return 0

    def iterate_groups(
        self, names: Sequence[str], start_s: float, end_s: float
    ) -> Iterator[pa.Table | LostGroup]:
        """Read the row groups that may have rows of a part of the run.

        Parameters
        ----------
        names : sequence of str
            Columns; the file has all of them.
        start_s, end_s : float
            The part; the end is excluded.
        """
        metadata = self._parquet.metadata
        for number in range(metadata.num_row_groups):
            known = None
            if self._entry and number < len(self._entry.groups):
                known = self._entry.groups[number]
            if known is not None and (known.last_s < start_s or known.first_s >= end_s):
                continue
            try:
                yield self._read_group(number, metadata.row_group(number), names)
            except _FAULTS as error:
                if known is not None:
                    first_s, last_s = known.first_s, known.last_s
                else:
                    first_s, last_s = None, None
                yield LostGroup(first_s, last_s, _first_line(error))

    def _read_footer(self) -> bytes:
        """The footer, from the manifest if that of the file differs. Raises PartError.

        Without its footer a Parquet file cannot be read at all, so the manifest has a copy.
        """
        expected = unpack_footer(self._entry.footer) if self._entry else None
        tail = self._bytes_at(max(0, self._size_bytes - TAIL_BYTES), TAIL_BYTES)
        length = int.from_bytes(tail[:4], "little")
        found = None
        if tail[4:] == MAGIC and length <= min(FOOTER_BYTES_MAX, self._size_bytes - TAIL_BYTES):
            found = self._bytes_at(self._size_bytes - TAIL_BYTES - length, length)
        if expected is not None and found != expected:
            self.notes.append(
                "its footer is damaged or missing: read with the copy in the manifest"
            )
            return expected
        if found is None:
            raise PartError("its footer is damaged or missing")
        return found

    def _open_with_footer(self, footer: bytes) -> pq.ParquetFile:
        """Open the file with this footer, whatever its own end is. Raises like pyarrow."""
        # A file that ends with the footer to use: pyarrow reads the metadata from it alone
        limits = {
            "thrift_string_size_limit": FOOTER_BYTES_MAX,
            "thrift_container_size_limit": _THRIFT_ITEMS_MAX,
        }
        whole = MAGIC + footer + len(footer).to_bytes(4, "little") + MAGIC
        metadata = pq.ParquetFile(pa.BufferReader(whole), **limits).metadata
        words = [metadata.schema.column(n).path for n in range(metadata.num_columns)]
        # a repeated string is kept once: a small file could claim gigabytes of them
        return pq.ParquetFile(
            self._file,
            metadata=metadata,
            read_dictionary=words,
            page_checksum_verification=True,
            **limits,
        )

    def _read_group(
        self, number: int, group: pq.RowGroupMetaData, names: Sequence[str]
    ) -> pa.Table:
        """Read the columns of a row group, after their sizes and checksums were checked."""
        if group.num_rows > GROUP_ROWS_MAX:
            raise ValueError("more rows than a recorder writes")
        # What the wanted columns unpack to, before memory is taken for them
        wanted = set(names)
        total_bytes = 0
        for place in range(group.num_columns):
            chunk = group.column(place)
            if chunk.path_in_schema.partition(".")[0] not in wanted:
                continue
            total_bytes += self._checked_bytes(number, place, chunk, group.num_rows)
            if total_bytes > GROUP_BYTES_MAX:
                raise ValueError("more than a recorder writes")
        table = self._parquet.read_row_group(number, columns=list(names), use_threads=False)
        return _decode_dictionaries(table.select(list(names)))

    def _checked_bytes(
        self, number: int, place: int, chunk: pq.ColumnChunkMetaData, rows: int
    ) -> int:
        """Bytes to which a column chunk unpacks. Raises ValueError if it is damaged,
        or too large.
        """
        # The bytes of the chunk, with the checksum of the manifest.
        start, size = chunk_span(chunk)
        if start < 0 or size < 0 or start + size > self._size_bytes:
            raise ValueError(f"column {chunk.path_in_schema} is cut off")
        data = self._bytes_at(start, size)
        expected = self._expected_crc32(number, place)
        if expected is not None and zlib.crc32(data) != expected:
            raise ValueError(f"column {chunk.path_in_schema} is damaged")
        # What they unpack to, by the headers of their pages.
        found = page_headers.measure_chunk(data)
        kind = self.schema.field(chunk.path_in_schema.partition(".")[0]).type
        most_values = rows * (kind.list_size if isinstance(kind, pa.FixedSizeListType) else 1)
        # a repeated value takes no room in the file, but its own in memory
        size_bytes = max(found.unpacked_bytes, most_values * _VALUE_BYTES)
        if found.values > most_values or size_bytes > CHUNK_BYTES_MAX:
            raise ValueError(f"column {chunk.path_in_schema} is larger than a recorder writes")
        return size_bytes

    def _expected_crc32(self, number: int, place: int) -> int | None:
        """Checksum of a column of a row group, from the manifest; None without one."""
        groups = self._entry.groups if self._entry else ()
        if number >= len(groups) or place >= len(groups[number].crc32):
            return None
        return groups[number].crc32[place]

    def _bytes_at(self, start: int, size: int) -> bytes:
        return os.pread(self._file.fileno(), size, start)

    def is_unchanged(self) -> bool:
        """Whether the file has the manifest's SHA-256; True without a manifest. Raises OSError."""
        if self._entry is None:
            return True
        return (
            self._size_bytes == self._entry.size_bytes
            and _hash_file(self._file) == self._entry.sha256
        )


def _hash_file(file: BinaryIO) -> str:
    found = hashlib.sha256()
    file.seek(0)
    while data := file.read(_HASH_BYTES):
        found.update(data)
    return found.hexdigest()


def _decode_dictionaries(table: pa.Table) -> pa.Table:
    """A table without dictionaries. Raises ValueError if its texts would take more than a recorder
    writes.
    """
    for place, field in enumerate(table.schema):
        if not pa.types.is_dictionary(field.type):
            continue
        column = table.column(place)
        total_bytes = sum(_text_bytes(chunk) for chunk in column.chunks)
        if total_bytes > CHUNK_BYTES_MAX:
            raise ValueError(f"column {field.name} has more text than a recorder writes")
        table = table.set_column(place, field.name, column.cast(field.type.value_type))
    return table


def _text_bytes(column: pa.DictionaryArray) -> int:
    sizes = pc.binary_length(column.dictionary)
    return int(pc.sum(pc.take(sizes, column.indices)).as_py() or 0)


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]
