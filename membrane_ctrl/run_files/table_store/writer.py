"""Writes a table of a run: rows to the journal within a second, full journals to parts.

A journal and the part made from it have the same number. Sealing a journal writes the part under
another name, syncs and renames it, appends its line to the manifest, and removes the journal. A
reader ignores a journal whose part exists, so that a kill between any two of these steps loses and
doubles nothing.
"""

import contextlib
import math
from collections import deque
from pathlib import Path

import pyarrow as pa

from membrane_ctrl.model.files import read_bytes
from membrane_ctrl.run_files.table_store import journal, spec
from membrane_ctrl.run_files.table_store.disk import Disk
from membrane_ctrl.run_files.table_store.manifest import read_manifest
from membrane_ctrl.run_files.table_store.sealing import seal_journal
from membrane_ctrl.run_files.table_store.spec import TableSpec

# Time for a person to make room on a full disk.
WAIT_S = 600.0


class TableWriter:
    """One table of a run, appended to.

    Parameters
    ----------
    run_dir : Path
        Folder of the run; the table has a folder in it.
    table : TableSpec
        Columns, time and limits of the files.
    resumed : bool
        Continue after a recorder that died: with its journals, and without repeating rows that it
        wrote.
    disk : Disk
        The system calls; tests replace them.

    Attributes
    ----------
    until_s : float
        Time of the last row taken; -inf without one.
    """

    def __init__(
        self, run_dir: Path, table: TableSpec, resumed: bool = False, disk: Disk | None = None
    ) -> None:
        self._folder = run_dir / table.name
        self._table = table
        self._disk = disk or Disk()
        self._waiting: deque[pa.RecordBatch] = deque()
        self._journal: journal.JournalWriter | None = None
        self._journal_from_s = math.inf
        self._sealable: deque[int] = deque()
        self._number = 0  # of the next journal
        self._next_row = 0  # number of the first row that waits
        self._given_up = 0
        self.until_s = -math.inf
        if resumed:
            self._continue_after_kill()

    def add_rows(self, batch: pa.RecordBatch) -> None:
        """Take rows; those not later than the last one taken are dropped. They are on the disk
        after `sync_rows`.
        """
        time_s = batch.column(self._table.time_name).to_numpy(zero_copy_only=False)
        if time_s.size and time_s[0] <= self.until_s:
            batch = batch.filter(pa.array(time_s > self.until_s))
        if not batch.num_rows:
            return
        self.until_s = float(time_s[-1])
        self._waiting.append(batch)

    def sync_rows(self) -> None:
        """Bring all rows taken to the disk.

        Raises OSError (full disk): they wait for the next call, those of the last `WAIT_S` at most.
        """
        if not self._waiting:
            return
        # A full journal is closed before new rows, so that each part begins with rows of its own
        first_s = self._time_s(self._waiting[0], 0)
        if self._journal is not None and self._is_full(self._journal):
            self._close_journal()
        # All that waits is one frame: it is on the disk whole, or not at all
        batch = pa.Table.from_batches(self._waiting).combine_chunks().to_batches()[0]
        try:
            if self._journal is None:
                self._begin_journal(first_s)
            assert self._journal is not None
            self._journal.append_batch(self._next_row, batch)
        except OSError:
            self._close_journal()  # another one follows what this one could not take
            self._drop_oldest()
            raise
        self._next_row += batch.num_rows
        self._waiting.clear()

    def _is_full(self, current: journal.JournalWriter) -> bool:
        return (
            self.until_s - self._journal_from_s >= self._table.part_s
            or current.size_bytes >= journal.JOURNAL_BYTES_MOST
        )

    def _begin_journal(self, first_s: float) -> None:
        while (path := spec.journal_path(self._folder, self._number)).exists():
            self._number += 1  # left by another recorder
        self._journal = journal.JournalWriter(self._disk, path, self._table.schema)
        self._journal_from_s = first_s
        self._number += 1

    def _close_journal(self) -> None:
        current, self._journal = self._journal, None
        if current is not None:
            self._sealable.append(self._number - 1)
            with contextlib.suppress(OSError):  # every frame is synced
                current.close()

    def _drop_oldest(self) -> None:
        """Drop the oldest rows if more than `WAIT_S` of them wait; their numbers stay unused."""
        while self.until_s - self._time_s(self._waiting[0], 0) > WAIT_S:
            dropped = self._waiting.popleft().num_rows
            self._given_up += dropped
            self._next_row += dropped

    def _time_s(self, batch: pa.RecordBatch, row: int) -> float:
        return float(batch.column(self._table.time_name)[row].as_py())

    def seal_next(self) -> bool:
        """Make a part of the oldest closed journal; whether there was one. Raises OSError; call
        again later.
        """
        if not self._sealable:
            return False
        seal_journal(self._disk, self._folder, self._sealable[0], self._table)
        self._sealable.popleft()
        return True

    def close(self) -> None:
        """Bring all rows to the disk and seal all journals. Raises OSError: unsealed journals are
        kept.
        """
        self.sync_rows()
        self._close_journal()
        while self.seal_next():
            pass

    def leave_folder(self) -> None:
        """Continue after the folder's removal: waiting rows go to its successor, written ones are
        lost.
        """
        self._close_journal()
        self._sealable.clear()

    @property
    def lost_rows(self) -> int:
        """Rows that no file has: given up, or still waiting for the disk."""
        return self._given_up + sum(int(batch.num_rows) for batch in self._waiting)

    @property
    def part_count(self) -> int:
        """Number of parts and journals begun."""
        return self._number

    def _continue_after_kill(self) -> None:
        """Seal what a dead recorder left, and find the number and the time of the last row."""
        found = [spec.file_number(path) for path in _list_part_files(self._folder)]
        numbers = sorted(number for number in found if number is not None)
        if not numbers:
            return
        self._number = numbers[-1] + 1
        # Journals without a part are sealed soon
        journals = [
            number for number in numbers if spec.journal_path(self._folder, number).exists()
        ]
        # The last row, from the manifest and from journals that it does not list
        self._sealable.extend(dict.fromkeys(journals))
        listed = read_manifest(self._folder, [])
        for entry in listed.values():
            self._note_rows(entry.first_row + entry.rows, entry.last_s)
        for number in self._sealable:
            if number not in listed:
                self._note_journal(number)

    def _note_journal(self, number: int) -> None:
        with contextlib.suppress(OSError, ValueError, pa.ArrowException):
            data = read_bytes(spec.journal_path(self._folder, number), journal.FILE_BYTES_MAX)
            for block in journal.read_journal(data, self._table.group_rows, self._table.schema):
                if not isinstance(block, journal.JournalBlock):
                    continue
                times = block.table.column(self._table.time_name)
                last_s = float(times[-1].as_py())
                self._note_rows(block.first_row + block.table.num_rows, last_s)

    def _note_rows(self, next_row: int, last_s: float) -> None:
        self._next_row = max(self._next_row, next_row)
        self.until_s = max(self.until_s, last_s)


def _list_part_files(folder: Path) -> list[Path]:
    return [*folder.glob(f"*{spec.PART_SUFFIX}"), *folder.glob(f"*{spec.JOURNAL_SUFFIX}")]
