"""Makes a part of a closed journal: write, sync, rename, record,
and only then remove the journal.
"""

from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa

from membrane_ctrl.model.files import read_bytes
from membrane_ctrl.run_files.table_store import spec
from membrane_ctrl.run_files.table_store.disk import Disk
from membrane_ctrl.run_files.table_store.journal import (
    FILE_BYTES_MAX,
    JournalBlock,
    LostBytes,
    read_journal,
)
from membrane_ctrl.run_files.table_store.manifest import append_entry, read_manifest
from membrane_ctrl.run_files.table_store.part_writer import write_part


def seal_journal(disk: Disk, folder: Path, number: int, table: spec.TableSpec) -> None:
    """Make the part of a journal: write, sync, rename, record, and only then remove the journal.

    Parameters
    ----------
    disk : Disk
        The system calls.
    folder : Path
        Of the table.
    number : int
        Of the journal, and of the part.
    table : TableSpec
        Columns and limits.

    Raises
    ------
    OSError
        The disk is full, or the journal cannot be read; the journal stays.
    """
    source = spec.journal_path(folder, number)
    target = spec.part_path(folder, number)
    # Killed after the manifest's line was written: only the journal's removal is left to do. A kill
    # at any earlier step leaves the whole journal, and everything is done again
    if target.exists() and number in read_manifest(folder, []):
        disk.remove(source)
        return
    rows = _JournalRows(read_bytes(source, FILE_BYTES_MAX), table)
    try:
        entry = write_part(
            disk, target, number, rows.first_row, rows.iterate_groups(), table.time_name
        )
    except (ValueError, pa.ArrowException) as error:
        raise OSError(f"{source.name}: cannot be sealed ({error})") from None
    if entry is not None:
        append_entry(disk, folder, entry.model_copy(update={"damage": tuple(rows.damage)}))
    # A journal without one intact row stays, for `repair` and for people; an empty one goes
    if entry is not None or not rows.damage:
        disk.remove(source)


class _JournalRows:
    """The rows of a journal, read once; `damage` describes what is lost of it."""

    def __init__(self, data: bytes, table: spec.TableSpec) -> None:
        self.damage: list[str] = []
        self._group_rows = table.group_rows
        self._blocks = read_journal(data, table.group_rows, table.schema)
        self._first = self._next_block()
        if self._first is not None:
            self.first_row = self._first.first_row
        else:
            self.first_row = 0

    def iterate_groups(self) -> Iterator[pa.Table]:
        """Tables of about `group_rows` rows."""
        waiting: list[pa.Table] = []
        count = 0
        block = self._first
        while block is not None:
            waiting.append(block.table)
            count += block.table.num_rows
            if count >= self._group_rows:
                yield pa.concat_tables(waiting).combine_chunks()
                waiting, count = [], 0
            block = self._next_block()
        if waiting:
            yield pa.concat_tables(waiting).combine_chunks()

    def _next_block(self) -> JournalBlock | None:
        for block in self._blocks:
            if isinstance(block, JournalBlock):
                return block
            self.damage.append(describe_lost_bytes(block))
        return None


def describe_lost_bytes(lost: LostBytes) -> str:
    """A damaged stretch of a journal in words."""
    where = "at the end" if lost.at_end else "within"
    return f"{lost.size_bytes} bytes {where} are no intact rows"
