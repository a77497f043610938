"""Reads the new rows of a table that is being written.

A call reads only what the journal has got since the last call. When a journal has become a part,
the rows that are still missing are read from the files, by their time.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa

from membrane_ctrl.model.files import open_plain
from membrane_ctrl.run_files.table_store import journal, spec
from membrane_ctrl.run_files.table_store.reader import TableReader
from membrane_ctrl.run_files.table_store.spec import TableSpec


class TableFollower:
    """Reads a growing table.

    Parameters
    ----------
    run_dir : Path
        Folder of the run, which is in progress.
    table : TableSpec
        Columns and limits.
    after : float
        Rows up to this value of the table's time column are left out.
    """

    def __init__(self, run_dir: Path, table: TableSpec, after: float = -math.inf) -> None:
        self._run_dir = run_dir
        self._folder = run_dir / table.name
        self._table = table
        self._after = after
        self._parts = -1  # number of parts at the last call
        self._number = -1  # of the journal that is read
        self._place = 0  # end of its last frame that was read
        self._is_ours = False  # whether it has the columns of the table

    def read_new(self) -> list[pa.Table]:
        """Return the rows since the last call, in order. Damaged rows are left out."""
        parts = len(list(self._folder.glob(f"*{spec.PART_SUFFIX}")))
        if parts != self._parts:
            tables = self._read_files()
        else:
            tables = self._read_journals()
        self._parts = parts
        return [newer for table in tables if (newer := self._keep_newer(table)).num_rows]

    def _read_files(self) -> Iterator[pa.Table]:
        first = math.nextafter(self._after, math.inf)
        for table in TableReader(self._run_dir, self._table, []).iterate_tables(start_s=first):
            if table.column_names == self._table.schema.names:
                yield table

    def _read_journals(self) -> Iterator[pa.Table]:
        found = map(spec.file_number, self._folder.glob(f"*{spec.JOURNAL_SUFFIX}"))
        for number in sorted(n for n in found if n is not None and n >= self._number):
            if number > self._number:
                self._number = number
                self._place = 0
                self._is_ours = False
            yield from self._read_frames(spec.journal_path(self._folder, number))

    def _read_frames(self, path: Path) -> Iterator[pa.Table]:
        """Yield the rows of the frames that a journal has gained since the last call."""
        try:
            with open_plain(path) as file:
                file.seek(self._place)
                data = file.read(journal.FILE_BYTES_MAX)
        except OSError:  # sealed in the meantime: the next call reads the part
            return
        begin = self._place
        for frame in journal.find_frames(data):
            self._place = begin + frame.end
            try:
                if not frame.rows:
                    self._is_ours = journal.read_schema(frame).equals(self._table.schema)
                elif self._is_ours:
                    batch = journal.read_batch(frame, self._table.schema)
                    yield pa.Table.from_batches([batch])
            except (pa.ArrowException, OSError, ValueError):  # damaged
                continue

    def _keep_newer(self, table: pa.Table) -> pa.Table:
        times = table.column(self._table.time_name).to_numpy()
        newer = table.filter(pa.array(times > self._after))
        if newer.num_rows:
            self._after = float(times.max())
        return newer
