"""What a table has not written yet, on the disk all the same: a small file beside it that a crash leaves behind.

A batch of a table has to be large to be worth its header, so rows wait for a minute and more. Meanwhile they go to
`columns/<table>-waiting.arrows` each second, an Arrow stream of many small batches, which ends with the large
batch it was made for. A reader takes it for the last file of the table; the next recorder takes its rows over.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa

from membrane_ctrl.recording.atomic import sync_data
from membrane_ctrl.recording.sealed_stream import SealedStream, whole_batches


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
