"""Tables of a run: a kill at any system call, a power cut and a full disk lose a second, and double
nothing.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from membrane_ctrl.run_files.table_store import journal, spec
from membrane_ctrl.run_files.table_store.reader import TableReader
from membrane_ctrl.run_files.table_store.writer import WAIT_S, TableWriter
from tests.support.table_disk import (
    TABLE,
    FullDisk,
    KilledError,
    KillingDisk,
    batch_of,
    read_counts,
)

ROWS = 15  # in parts of twelve


def _write_all(run_dir: Path, disk: KillingDisk, synced: list[int]) -> None:
    """Write the rows one by one, as a recorder does each second; `synced` has those that it
    believes safe.
    """
    writer = TableWriter(run_dir, TABLE, disk=disk)
    for count in range(ROWS):
        writer.add_rows(batch_of([count]))
        writer.sync_rows()
        synced.append(count)
        writer.seal_next()
    writer.close()


def _calls() -> list[str]:
    import tempfile

    disk = KillingDisk()
    with tempfile.TemporaryDirectory() as folder:
        _write_all(Path(folder), disk, [])
    return disk.calls


CALLS = _calls()


KILLS = [
    (at, share)
    for at, call in enumerate(CALLS)
    for share in ((0.0, 0.6) if call == "write" else (0.0,))
]


@pytest.mark.parametrize(("at", "share"), KILLS)
def test_a_kill_at_any_call_loses_and_doubles_nothing(
    tmp_path: Path, at: int, share: float
) -> None:
    synced: list[int] = []
    with pytest.raises(KilledError):
        _write_all(tmp_path, KillingDisk(at, share), synced)

    found = read_counts(tmp_path)
    assert found in (synced, [*synced, len(synced)]), "the row being written may be there or not"

    writer = TableWriter(tmp_path, TABLE, resumed=True, disk=KillingDisk())
    for count in range(max(0, len(synced) - 3), ROWS):  # the ring still has a few of the old rows
        writer.add_rows(batch_of([count]))
        writer.sync_rows()
    writer.close()
    notes: list[str] = []
    assert read_counts(tmp_path, notes) == list(range(ROWS))
    assert not [note for note in notes if "no intact rows" not in note], (
        "only a torn frame may be noted"
    )
    left = [path.read_bytes() for path in (tmp_path / TABLE.name).glob(f"*{spec.JOURNAL_SUFFIX}")]
    assert not any(frame.rows for data in left for frame in journal.find_frames(data)), (
        "torn before any row"
    )


def test_every_step_of_sealing_is_interrupted() -> None:
    """The calls above contain each step of sealing, in its safe order."""
    rename = CALLS.index("rename")
    assert CALLS[rename - 3 : rename] == ["write", "sync", "close"]
    record = ["open_to_append", "write", "sync", "close"]
    assert CALLS[rename : rename + 7] == ["rename", "sync_folder", *record, "remove"]


def _journal_of(run_dir: Path, rows: int) -> Path:
    """The journal of a recorder that was killed after so many rows."""
    writer = TableWriter(run_dir, TABLE)
    for count in range(rows):
        writer.add_rows(batch_of([count]))
        writer.sync_rows()
    return spec.journal_path(run_dir / TABLE.name, 0)


@pytest.mark.parametrize("zeroed", [False, True], ids=["truncated", "zeroed"])
def test_a_power_cut_costs_the_last_frame_at_most(tmp_path: Path, zeroed: bool) -> None:
    path = _journal_of(tmp_path, 5)
    whole = path.read_bytes()
    last = journal.find_frames(whole)[-1]
    for cut in range(last.start, len(whole)):
        path.write_bytes(whole[:cut] + bytes((len(whole) - cut) * zeroed))
        notes: list[str] = []
        found = read_counts(tmp_path, notes)
        assert found == [0, 1, 2, 3], cut
        assert bool(notes) == (zeroed or cut > last.start)


def test_a_journal_cut_at_any_byte_is_continued(tmp_path: Path) -> None:
    path = _journal_of(tmp_path, 5)
    whole = path.read_bytes()
    frames = journal.find_frames(whole)
    for place, frame in enumerate(frames):
        for cut in (
            frame.start,
            frame.start + 1,
            frame.start + 31,
            frame.start + 32,
            frame.end - 1,
        ):
            for old in path.parent.iterdir():
                old.unlink()
            path.write_bytes(whole[:cut])
            writer = TableWriter(tmp_path, TABLE, resumed=True)
            for count in range(max(0, place - 1), 8):
                writer.add_rows(batch_of([count]))
            writer.close()
            assert read_counts(tmp_path) == list(range(8)), cut


def test_readers_see_each_row_as_soon_as_it_is_synced(tmp_path: Path) -> None:
    writer = TableWriter(tmp_path, TABLE)
    for count in range(30):
        writer.add_rows(batch_of([count]))
        writer.sync_rows()
        assert read_counts(tmp_path) == list(range(count + 1))
        writer.seal_next()


def test_a_journal_sealed_while_it_is_read_is_read_from_its_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = TableWriter(tmp_path, TABLE)
    writer.add_rows(batch_of(range(10)))
    writer.sync_rows()
    reader = TableReader(tmp_path, TABLE, [])
    exists = Path.exists

    def sealed_after(path: Path) -> bool:
        found = exists(path)
        if path.suffix == spec.PART_SUFFIX:
            monkeypatch.undo()
            writer.close()
        return found

    monkeypatch.setattr(Path, "exists", sealed_after)
    assert [
        count
        for table in reader.iterate_tables(["count"])
        for count in table.column("count").to_pylist()
    ] == [*range(10)]


@pytest.mark.parametrize("free_bytes", [0, 1, 40, 700, 3000])
def test_a_full_disk_loses_nothing_within_ten_minutes(tmp_path: Path, free_bytes: int) -> None:
    disk = FullDisk()
    writer = TableWriter(tmp_path, TABLE, disk=disk)
    step_s = 60.0
    for count in range(5):
        writer.add_rows(batch_of([count], step_s))
        writer.sync_rows()
    disk.free_bytes = free_bytes
    before = _counts(tmp_path)
    for count in range(5, 15):
        writer.add_rows(batch_of([count], step_s))
        with contextlib.suppress(OSError):
            writer.sync_rows()
        assert _counts(tmp_path)[: len(before)] == before, "what was readable stays readable"
    disk.free_bytes = 1 << 40
    writer.add_rows(batch_of([15], step_s))
    writer.close()
    assert _counts(tmp_path) == list(range(16))
    assert writer.lost_rows == 0


def test_a_disk_that_is_full_for_longer_loses_only_what_exceeds_ten_minutes(tmp_path: Path) -> None:
    disk = FullDisk()
    writer = TableWriter(tmp_path, TABLE, disk=disk)
    writer.add_rows(batch_of([0], 60.0))
    writer.sync_rows()
    disk.free_bytes = 0
    for count in range(1, 31):
        writer.add_rows(batch_of([count], 60.0))
        with pytest.raises(OSError, match="No space"):
            writer.sync_rows()
    kept = round(WAIT_S / 60.0) + 1
    disk.free_bytes = 1 << 40
    writer.close()
    assert _counts(tmp_path) == [0, *range(31 - kept, 31)]
    assert writer.lost_rows == 30 - kept


def test_a_disk_that_is_full_while_sealing_keeps_the_journal(tmp_path: Path) -> None:
    disk = FullDisk()
    writer = TableWriter(tmp_path, TABLE, disk=disk)
    for count in range(14):
        writer.add_rows(batch_of([count]))
        writer.sync_rows()
    for free_bytes in (0, 1, 500, 2000):
        disk.free_bytes = free_bytes
        with pytest.raises(OSError, match="No space"):
            writer.seal_next()
        assert read_counts(tmp_path) == list(range(14))
    disk.free_bytes = 1 << 40
    assert writer.seal_next()
    assert read_counts(tmp_path) == list(range(14))
    assert spec.part_path(tmp_path / TABLE.name, 0).exists()


def test_a_removed_folder_starts_again_with_what_waits(tmp_path: Path) -> None:
    import shutil

    writer = TableWriter(tmp_path, TABLE)
    writer.add_rows(batch_of([0]))
    writer.sync_rows()
    shutil.rmtree(tmp_path / TABLE.name)
    writer.leave_folder()
    writer.add_rows(batch_of([1]))
    writer.close()
    assert read_counts(tmp_path) == [1]


def _counts(run_dir: Path) -> list[int]:
    return [
        count
        for table in TableReader(run_dir, TABLE, []).iterate_tables(["count"])
        for count in table["count"].to_pylist()
    ]
