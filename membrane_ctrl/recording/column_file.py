"""Tables beside the Rerun recording: Arrow streams that a crash leaves readable and that read back at disk speed.

A Rerun segment holds a chunk an entity a second: made for looking, not for a statistic over 2.6e7 ticks. So each
table is written a second time, as Arrow IPC streams `columns/<table>-000.arrows`, `-001`, ...: whole batches, no
footer, so that what a killed recorder leaves is good up to its last batch, each under a checksum (`sealed_stream`).
The batch it was filling is in a journal.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike

from membrane_ctrl.recording.atomic import sync_data
from membrane_ctrl.recording.column_journal import Journal
from membrane_ctrl.recording.sealed_stream import SealedStream, whole_batches

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
        """The folder was taken away: what waits goes to the one in its place, what is written is not there."""
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
