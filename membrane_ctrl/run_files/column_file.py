"""Tables beside the Rerun recording: Arrow streams that a crash leaves readable and that read back at disk speed.

A Rerun segment holds a chunk an entity a second: made for looking, not for a statistic over 2.6e7 ticks. So each
table is written a second time, as Arrow IPC streams `columns/<table>-000.arrows`, `-001`, ...: whole batches, no
footer, so that what a killed recorder leaves is good up to its last batch, each under a checksum (`sealed_stream`).
The batch it was filling is in a journal.
"""

import contextlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray

from membrane_ctrl.model.files import sync_data
from membrane_ctrl.run_files.sealed_stream import SealedStream, whole_batches

# What a table has not written yet, on the disk all the same: a small file beside it that a crash leaves behind.
#
# A batch of a table has to be large to be worth its header, so rows wait for a minute and more. Meanwhile they go to
# `columns/<table>-waiting.arrows` each second, an Arrow stream of many small batches, which ends with the large
# batch it was made for. A reader takes it for the last file of the table; the next recorder takes its rows over.


class Journal:
    """The file of one table.

    Parameters
    ----------
    path : Path
        Where it is; there is none while nothing waits.
    schema : pa.Schema
        Of the table.
    """

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        self._path = path
        self._schema = schema
        self._stream: SealedStream | None = None
        self._kept = 0  # batches in it

    def left_behind(self) -> list[pa.RecordBatch]:
        """Whole batches that a recorder has left; what it was writing when it was killed is not among them."""
        found: list[pa.RecordBatch] = []
        with contextlib.suppress(OSError, pa.ArrowException):
            found.extend(batch for batch in whole_batches(self._path) if batch.schema.equals(self._schema))
        return found

    def keep(self, waiting: Sequence[pa.RecordBatch]) -> None:
        """Add what is not yet in it, and wait until the disk has it.

        Raises
        ------
        OSError
            Full disk: the next call begins anew, with all that waits.
        """
        if self._kept == len(waiting):
            return
        try:
            if self._stream is None:
                self._begin(waiting)
            else:
                for batch in waiting[self._kept :]:
                    self._stream.write(batch)
            sync_data(self._path)
        except OSError:
            self.drop()
            raise
        self._kept = len(waiting)

    def drop(self) -> None:
        """Nothing waits any more."""
        if self._stream is not None:
            self._stream.abandon()
        self._stream = None
        self._kept = 0
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)

    def _begin(self, waiting: Sequence[pa.RecordBatch]) -> None:
        """A new file takes the old one's place once all is in it: what was left behind is never without a copy."""
        self._path.parent.mkdir(exist_ok=True)
        part = self._path.with_suffix(".part")
        self._stream = SealedStream(part, self._schema)
        for batch in waiting:
            self._stream.write(batch)
        part.replace(self._path)


FOLDER = "columns"
SUFFIX = ".arrows"
SCHEMA_NAME = "membrane-columns/1"
# As the Rerun segments: what is damaged is damaged for six hours at most.
FILE_S = 6 * 3600.0


class ColumnFile:
    """One table, appended to in batches.

    Parameters
    ----------
    run_dir : Path
        Folder of the run.
    table : str
        Name in front of the number.
    schema : pa.Schema
        Of its columns; one of them is `time_name`.
    time_name : str
        Seconds of the run, rising.
    batch_s : float
        Rows wait in memory and in the journal until they span this long.
    resumed : bool
        Go on where another recorder died: with its journal, and without a row that it has written.

    Attributes
    ----------
    lost : int
        Rows given up because the disk would not take them.
    """

    def __init__(
        self, run_dir: Path, table: str, schema: pa.Schema, time_name: str, batch_s: float, resumed: bool = False
    ) -> None:
        self._folder = run_dir / FOLDER
        self._table = table
        about = {"schema": SCHEMA_NAME, "table": table, "run": run_dir.name}
        self._schema = schema.with_metadata(about)
        self._time_name = time_name
        self._batch_s = batch_s
        self._waiting: list[pa.RecordBatch] = []
        self._until_s = -math.inf  # time of the last row taken in
        self._number = 0
        self._path = self._folder
        self._file_until_s = 0.0
        self._stream: SealedStream | None = None
        self.lost = 0
        self._journal = Journal(self._folder / f"{table}-waiting{SUFFIX}", self._schema)
        if resumed:
            self._until_s = self._last_written_s()
            for batch in self._journal.left_behind():
                self._take(batch)

    def add(self, columns: Mapping[str, ArrayLike]) -> None:
        """Take in rows that are later than those before; a full batch goes to the disk.

        Raises
        ------
        OSError
            Full disk: the full batch is lost.
        """
        arrays = [pa.array(columns[field.name], type=field.type) for field in self._schema]
        if not self._take(pa.record_batch(arrays, schema=self._schema)):
            return
        if self._until_s - self._first_s >= self._batch_s:
            self.flush()

    def _take(self, batch: pa.RecordBatch) -> bool:
        """Let rows wait; whether there was one that is new."""
        time_s = np.asarray(batch.column(self._time_name))
        if time_s.size and time_s[0] <= self._until_s:
            batch = batch.filter(pa.array(time_s > self._until_s))
        if not batch.num_rows:
            return False
        self._until_s = float(time_s[-1])
        self._waiting.append(batch)
        return True

    @property
    def _first_s(self) -> float:
        return float(self._waiting[0].column(self._time_name)[0].as_py())

    def flush(self) -> None:
        """Write what waits as one batch. Raises OSError as `add`."""
        if not self._waiting:
            return
        first_s = self._first_s
        batches, self._waiting = self._waiting, []
        batch = pa.Table.from_batches(batches).combine_chunks().to_batches()[0]
        try:
            self._open_for(first_s).write(batch)
            sync_data(self._path)  # before the journal goes
            self._journal.drop()
        except OSError:
            self.lost += batch.num_rows
            with contextlib.suppress(OSError):
                self.close_file()
            raise

    def sync(self) -> None:
        """Bring what waits to the journal. Raises OSError (full disk): it goes on waiting."""
        self._journal.keep(self._waiting)

    def close(self) -> None:
        """Write what waits and end the file. Raises OSError."""
        self.flush()
        self.close_file()

    def close_file(self) -> None:
        """End the file there is; the next batch begins another."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()

    def leave_folder(self) -> None:
        """The folder was removed: waiting rows go to its successor, written ones are not there."""
        with contextlib.suppress(OSError):
            self.close_file()
        self._journal.drop()

    @property
    def files(self) -> int:
        """Files of the table that are there."""
        return sum(1 for _ in self._folder.glob(f"{self._table}-[0-9]*{SUFFIX}"))

    def _open_for(self, time_s: float) -> SealedStream:
        if self._stream is not None and time_s >= self._file_until_s:
            self.close_file()
        if self._stream is None:
            self._folder.mkdir(exist_ok=True)
            while (path := self._folder / f"{self._table}-{self._number:03d}{SUFFIX}").exists():
                self._number += 1  # also those of a recorder that was killed
            self._path = path
            self._stream = SealedStream(path, self._schema, "zstd")
            self._file_until_s = time_s + FILE_S
        return self._stream

    def _last_written_s(self) -> float:
        """Time of the last row in the table's newest file that can be read; -inf without one."""
        for path in sorted(self._folder.glob(f"{self._table}-[0-9]*{SUFFIX}"), reverse=True):
            last_s = -math.inf
            with contextlib.suppress(OSError, pa.ArrowException):
                for batch in whole_batches(path, [self._time_name]):
                    last_s = float(batch.column(0)[-1].as_py())
            if last_s > -math.inf:
                return last_s
        return -math.inf


# Tick records as columns that zlib can make something of, and back to the last bit.
#
# A column whose values are short decimals (a device counts in tenths of a micrometre, and 12.3 is the double nearest
# to 123 / 10) goes as the differences of those whole numbers; any other as the exclusive or with the tick before. Of
# either the bytes are sorted by their place: the first of all ticks, then the second.


_AS_IT_IS = 255
_DIGITS_MAX = 6


def encode_columns(records: NDArray[np.void]) -> bytes:
    """(n,) records as bytes: for each field its code (digits, or 255) and its column."""
    if not len(records):
        return b""
    return b"".join(_encode(np.ascontiguousarray(records[name])) for name in records.dtype.names or ())


def decode_columns(data: bytes, kind: np.dtype[np.void], count: int) -> tuple[NDArray[np.void], int]:
    """(count,) records of a kind, and how many bytes of `data` they took. Raises ValueError if there are too few."""
    # before the memory is taken: a count may be anything
    if count * sum(min(4, kind[name].itemsize) for name in kind.names or ()) > len(data):
        raise ValueError(f"{count} ticks are said to be in {len(data)} bytes")
    records = np.empty(count, dtype=kind)
    if not count:
        return records, 0
    place = 0
    for name in kind.names or ():
        field = kind[name]
        if place >= len(data):
            raise ValueError("too short for its ticks")
        code = data[place]
        if code != _AS_IT_IS and (code > _DIGITS_MAX or field.kind != "f"):
            raise ValueError(f"column {name} has no code {code}")
        size = count * (4 if code != _AS_IT_IS else field.itemsize)
        records[name] = _decode(code, data[place + 1 : place + 1 + size], field, count)
        place += 1 + size
    return records, place


def _encode(column: NDArray[Any]) -> bytes:
    if column.dtype.kind == "f" and np.isfinite(column).all():
        largest = float(np.abs(column).max())
        for digits in range(_DIGITS_MAX + 1):
            if largest * 10.0**digits >= 2**30:
                break
            whole = np.rint(column * 10.0**digits).astype("<i4")
            if _same(whole / 10.0**digits, column):
                return bytes([digits]) + _by_place(np.diff(whole, prepend=np.int32(0)).astype("<i4"))
    planes = column.view("u1").reshape(len(column), -1)
    return bytes([_AS_IT_IS]) + _by_place(np.vstack((planes[:1], planes[1:] ^ planes[:-1])))


def _decode(code: int, data: bytes, field: np.dtype[Any], count: int) -> NDArray[Any]:
    width = 4 if code != _AS_IT_IS else field.itemsize
    planes = np.frombuffer(data, dtype="u1").reshape(width, count).T
    if code == _AS_IT_IS:
        return np.ascontiguousarray(np.bitwise_xor.accumulate(planes, axis=0)).view(field).reshape(count)
    steps = np.ascontiguousarray(planes).view("<i4").reshape(count)
    decoded: NDArray[Any] = np.cumsum(steps, dtype=np.int64) / 10.0**code
    return decoded


def _same(values: NDArray[Any], column: NDArray[Any]) -> bool:
    """To the last bit: minus zero is not zero."""
    return bool(np.array_equal(values.view("<u8"), column.view("<u8")))


def _by_place(values: NDArray[Any]) -> bytes:
    return np.ascontiguousarray(values.view("u1").reshape(len(values), -1).T).tobytes()
