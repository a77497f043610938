"""Disks for tests of table files, one that dies at a chosen call, one that is full; and a table to
write to them.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from membrane_ctrl.run_files.table_store.disk import Disk
from membrane_ctrl.run_files.table_store.reader import TableReader
from membrane_ctrl.run_files.table_store.spec import TableSpec

TABLE = TableSpec(
    "numbers",
    pa.schema(
        [
            pa.field("time_s", pa.float64(), metadata={"unit": "s"}),
            pa.field("count", pa.int64()),
            pa.field("value", pa.float32()),
            pa.field("bits", pa.float64()),
            pa.field("word", pa.string()),
            pa.field("pair", pa.list_(pa.float64(), 2)),
            pa.field("data", pa.binary()),
        ]
    ),
    "time_s",
)
STEP_S = 300.0  # between rows: a part has twelve


class KilledError(BaseException):
    """The process died."""


class KillingDisk(Disk):
    """Dies at the call of a number, before it (`share` 0) or after a share of a write."""

    def __init__(self, at: int = -1, share: float = 0.0) -> None:
        self.calls: list[str] = []
        self._at = at
        self._share = share

    def _step(self, name: str) -> None:
        self.calls.append(name)
        if len(self.calls) - 1 == self._at and name != "write":
            raise KilledError(name)
        if len(self.calls) - 1 > self._at >= 0:
            raise KilledError("a dead process calls nothing")

    def make_folder(self, path: Path) -> None:
        self._step("make_folder")
        super().make_folder(path)

    def create(self, path: Path) -> int:
        self._step("create")
        return super().create(path)

    def open_to_append(self, path: Path) -> int:
        self._step("open_to_append")
        return super().open_to_append(path)

    def write(self, descriptor: int, data: bytes) -> None:
        self._step("write")
        if len(self.calls) - 1 == self._at:
            super().write(descriptor, data[: int(self._share * len(data))])
            raise KilledError("write")
        super().write(descriptor, data)

    def sync(self, descriptor: int) -> None:
        self._step("sync")

    def truncate(self, descriptor: int, size_bytes: int) -> None:
        self._step("truncate")
        super().truncate(descriptor, size_bytes)

    def close(self, descriptor: int) -> None:
        super().close(descriptor)
        self._step("close")

    def rename(self, source: Path, target: Path) -> None:
        self._step("rename")
        super().rename(source, target)

    def remove(self, path: Path) -> None:
        self._step("remove")
        super().remove(path)

    def sync_folder(self, path: Path) -> None:
        self._step("sync_folder")


class FullDisk(Disk):
    """Takes `free_bytes` more; a write beyond that is cut off and raises `ENOSPC`."""

    def __init__(self, free_bytes: int = 1 << 40) -> None:
        self.free_bytes = free_bytes

    def create(self, path: Path) -> int:
        if not self.free_bytes:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return super().create(path)

    def write(self, descriptor: int, data: bytes) -> None:
        fitting = min(len(data), self.free_bytes)
        super().write(descriptor, data[:fitting])
        self.free_bytes -= fitting
        if fitting < len(data):
            raise OSError(errno.ENOSPC, "No space left on device")

    def sync(self, descriptor: int) -> None:
        pass

    def sync_folder(self, path: Path) -> None:
        pass


def batch_of(counts: Sequence[int], step_s: float = STEP_S) -> pa.RecordBatch:
    """Rows of `TABLE` with these counts."""
    wanted = np.asarray(counts, dtype=np.int64)
    values = [None if count % 5 == 0 else count / 4 for count in counts]
    columns = {
        "time_s": wanted * step_s,
        "count": wanted,
        "value": pa.array(values, type=pa.float32()),
        "bits": np.where(wanted % 7 == 0, np.nan, np.sin(wanted)),
        "word": [f"word {count % 3}" for count in counts],
        "pair": pa.FixedSizeListArray.from_arrays(pa.array(np.repeat(wanted * 1.5, 2)), 2),
        "data": [bytes([count % 256]) * (count % 9) for count in counts],
    }
    arrays = [pa.array(columns[field.name], type=field.type) for field in TABLE.schema]
    return pa.record_batch(arrays, schema=TABLE.schema)


def read_counts(run_dir: Path, notes: list[str] | None = None) -> list[int]:
    """The counts of all readable rows, each row compared with what was written."""
    found: list[int] = []
    for table in TableReader(run_dir, TABLE, [] if notes is None else notes).iterate_tables():
        counts = table.column("count").to_pylist()
        expected = pa.Table.from_batches([batch_of(counts)])
        for name in TABLE.schema.names:
            assert repr(table.column(name).to_pylist()) == repr(
                expected.column(name).to_pylist()
            ), name
        found += counts
    return found
