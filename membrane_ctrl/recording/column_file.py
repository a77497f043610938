"""Tables beside the Rerun recording: Arrow streams that a crash leaves readable and that read back at disk speed.

A Rerun segment holds a chunk an entity a second: made for looking, not for a statistic over 2.6e7 ticks. So each
table is written a second time, as Arrow IPC streams `columns/<table>-000.arrows`, `-001`, ...: whole batches, no
footer, so that what a killed recorder leaves is good up to its last batch.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike

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
        Rows wait in memory until they span this long: what a killed recorder loses of this table.

    Attributes
    ----------
    lost : int
        Rows given up because the disk would not take them.
    """

    def __init__(self, run_dir: Path, table: str, schema: pa.Schema, time_name: str, batch_s: float) -> None:
        self._folder = run_dir / FOLDER
        self._table = table
        about = {"schema": SCHEMA_NAME, "table": table, "run": run_dir.name}
        self._schema = schema.with_metadata(about)
        self._time_name = time_name
        self._batch_s = batch_s
        self._waiting: list[pa.RecordBatch] = []
        self._first_s = 0.0
        self._number = 0
        self._file_until_s = 0.0
        self._sink: pa.NativeFile | None = None
        self._writer: pa.RecordBatchWriter | None = None
        self.lost = 0

    def add(self, columns: Mapping[str, ArrayLike]) -> None:
        """Take in rows; a full batch goes to the disk. Raises OSError (full disk): the batch is then lost."""
        arrays = [pa.array(columns[field.name], type=field.type) for field in self._schema]
        batch = pa.record_batch(arrays, schema=self._schema)
        if not batch.num_rows:
            return
        time_s = np.asarray(columns[self._time_name])
        if not self._waiting:
            self._first_s = float(time_s[0])
        self._waiting.append(batch)
        if float(time_s[-1]) - self._first_s >= self._batch_s:
            self.flush()

    def flush(self) -> None:
        """Write what waits as one batch. Raises OSError as `add`."""
        if not self._waiting:
            return
        batches, self._waiting = self._waiting, []
        batch = pa.Table.from_batches(batches).combine_chunks().to_batches()[0]
        try:
            self._open_for(self._first_s).write_batch(batch)
        except OSError:
            self.lost += batch.num_rows
            with contextlib.suppress(OSError):
                self.close_file()
            raise

    def close(self) -> None:
        """Write what waits and end the file. Raises OSError."""
        self.flush()
        self.close_file()

    def close_file(self) -> None:
        """End the file there is; the next batch begins another."""
        writer, sink, self._writer, self._sink = self._writer, self._sink, None, None
        if writer is not None and sink is not None:
            writer.close()
            sink.close()

    def _open_for(self, time_s: float) -> pa.RecordBatchWriter:
        if self._writer is not None and time_s >= self._file_until_s:
            self.close_file()
        if self._writer is None:
            self._folder.mkdir(exist_ok=True)
            while (path := self._folder / f"{self._table}-{self._number:03d}{SUFFIX}").exists():
                self._number += 1  # also those of a recorder that was killed
            self._sink = pa.OSFile(str(path), "wb")
            self._file_until_s = time_s + FILE_S
            # one thread: compressing is not urgent, the tick beside it is
            options = pa.ipc.IpcWriteOptions(compression="zstd", use_threads=False)
            self._writer = pa.ipc.new_stream(self._sink, self._schema, options=options)
        return self._writer
