"""Tables beside the Rerun recording: Arrow streams that survive crashes and read back at disk speed.

A table is `columns/<table>-000.arrows`, `-001`, ...: whole batches, no footer, so that a killed recorder's file is
good up to its last batch, each with a checksum (`sealed_stream`). The batch it was filling is in a journal.
"""

import contextlib
import math
import os
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike

from membrane_ctrl import __version__
from membrane_ctrl.model.files import sync_data
from membrane_ctrl.run_files import column_codec
from membrane_ctrl.run_files.sealed_stream import SealedStream, whole_batches

# Rows that a table has not written yet are on disk too: in a small file beside it that survives a crash.
#
# A batch must be large to be worth its header, so rows wait for a minute or more. Meanwhile they go to
# `columns/<table>-waiting.arrows` every second, an Arrow stream of many small batches, which ends with the large
# batch it was made for. A reader treats it as the last file of the table; the next recorder takes over its rows.


class Journal:
    """One table's journal at `path`, while rows wait; `kept` batches are in it."""

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        self._path = path
        self._schema = schema
        self._stream: SealedStream | None = None
        self.kept = 0

    def left_behind(self) -> list[pa.RecordBatch]:
        """Whole batches left by an earlier recorder, without the one it was writing when killed."""
        found: list[pa.RecordBatch] = []
        with contextlib.suppress(OSError, pa.ArrowException):
            found.extend(batch for batch in whole_batches(self._path) if batch.schema.equals(self._schema))
        return found

    def keep(self, waiting: Sequence[pa.RecordBatch]) -> None:
        """Add new batches and sync. Raises OSError (full disk): the next call then starts afresh."""
        if self.kept == len(waiting):
            return
        try:
            if self._stream is None:
                self._begin(waiting)
            else:
                for batch in waiting[self.kept :]:
                    self._stream.write(batch)
            sync_data(self._path)
        except OSError:
            self.drop()
            raise
        self.kept = len(waiting)

    def drop(self) -> None:
        """Remove the journal, as nothing waits."""
        if self._stream is not None:
            self._stream.abandon()
        self._stream = None
        self.kept = 0
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)

    def _begin(self, waiting: Sequence[pa.RecordBatch]) -> None:
        """Replace the old file only once a new one is complete, so that its rows always have a copy."""
        self._path.parent.mkdir(exist_ok=True)
        part = self._path.with_suffix(".part")
        self._stream = SealedStream(part, self._schema)
        for batch in waiting:
            self._stream.write(batch)
        part.replace(self._path)


FOLDER = "columns"
SUFFIX = ".arrows"
SCHEMA_NAME = "membrane-columns/1"
PROGRAM = f"membrane-ctrl {__version__}"
# A damaged header costs at most six hours.
FILE_S = 6 * 3600.0
# Time for a person to make room on a full disk.
WAIT_S = 600.0


class ColumnFile:
    """One table of a run, appended to in batches; its column `time_name` holds rising seconds of the run.

    Rows wait in memory and in the journal until they span `batch_s`, and `WAIT_S` longer on a full disk. A `resumed`
    recorder continues after one that died: with its journal, and without repeating rows it wrote.
    """

    def __init__(
        self, run_dir: Path, table: str, schema: pa.Schema, time_name: str, batch_s: float, resumed: bool = False
    ) -> None:
        self._folder = run_dir / FOLDER
        self._table = table
        about = {"schema": SCHEMA_NAME, "table": table, "run": run_dir.name, "program": PROGRAM}
        self._schema = schema.with_metadata(about)
        self._time_name = time_name
        self._batch_s = batch_s
        self._stored = column_codec.stored_schema(self._schema)
        self._waiting: deque[pa.RecordBatch] = deque()
        self._until_s = -math.inf  # time of the last row taken
        self._number = 0
        self._path, self._head_bytes = self._folder, 0
        self._file_until_s = 0.0
        self._stream: SealedStream | None = None
        self._given_up = 0
        self._journal = Journal(self._folder / f"{table}-waiting{SUFFIX}", self._schema)
        if resumed:
            self._until_s = self._last_written_s()
            for batch in self._journal.left_behind():
                self._take(batch)

    def add(self, columns: Mapping[str, ArrayLike]) -> None:
        """Take rows later than the previous ones. Raises OSError (full disk): they then wait for the next call."""
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

    @property
    def lost(self) -> int:
        """Rows that no file has: given up, or still waiting for the disk."""
        return self._given_up + sum(int(batch.num_rows) for batch in list(self._waiting)[self._journal.kept :])

    def flush(self) -> None:
        """Write what waits as one batch. Raises OSError as `add`."""
        if not self._waiting:
            return
        batch = pa.Table.from_batches(self._waiting).combine_chunks().to_batches()[0]
        try:
            self._append(batch)
        except OSError:
            while self._until_s - self._first_s > self._batch_s + WAIT_S:
                self._given_up += self._waiting.popleft().num_rows
            raise
        self._waiting.clear()
        self._journal.drop()

    def _append(self, batch: pa.RecordBatch) -> None:
        """All of a batch, or nothing. Raises OSError."""
        stream, whole_bytes = self._open_for(self._first_s), 0
        try:
            whole_bytes = self._path.stat().st_size
            stream.write(*column_codec.encode(batch, self._stored))
            sync_data(self._path)  # before the journal goes
        except OSError:
            stream.abandon()
            self._stream = None
            with contextlib.suppress(OSError):  # half a batch is damage to a reader, and what is there is room
                if whole_bytes > self._head_bytes:
                    os.truncate(self._path, whole_bytes)
                else:
                    self._path.unlink(missing_ok=True)
            raise

    def sync(self) -> None:
        """Bring what waits to the journal. Raises OSError (full disk): it goes on waiting."""
        self._journal.keep(list(self._waiting))

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
        """Continue after the folder's removal: waiting rows go to its successor, written ones are lost."""
        with contextlib.suppress(OSError):
            self.close_file()
        self._journal.drop()

    @property
    def files(self) -> int:
        """Existing files of the table."""
        return sum(1 for _ in self._folder.glob(f"{self._table}-[0-9]*{SUFFIX}"))

    def _open_for(self, time_s: float) -> SealedStream:
        if self._stream is not None and time_s >= self._file_until_s:
            self.close_file()
        if self._stream is None:
            self._folder.mkdir(exist_ok=True)
            while (path := self._folder / f"{self._table}-{self._number:03d}{SUFFIX}").exists():
                self._number += 1  # counting those of a killed recorder
            try:
                self._stream = SealedStream(path, self._stored, "zstd")
                self._path, self._head_bytes = path, path.stat().st_size
            except OSError:
                path.unlink(missing_ok=True)
                raise
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
