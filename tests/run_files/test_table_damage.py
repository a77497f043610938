"""Tables of a run: damage costs its row group, is named, and changes no value; strangers' files
take no memory.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from membrane_ctrl.run_files.table_store import journal, page_headers, spec
from membrane_ctrl.run_files.table_store.manifest import read_manifest
from membrane_ctrl.run_files.table_store.part_writer import chunk_span
from membrane_ctrl.run_files.table_store.reader import TableReader
from membrane_ctrl.run_files.table_store.writer import TableWriter
from tests.support.table_disk import TABLE as LARGE_TABLE
from tests.support.table_disk import KillingDisk, batch_of, read_counts

STEP_S = 60.0  # sixty rows a part
TABLE = replace(LARGE_TABLE, group_rows=20)


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A table of two parts, each of three row groups, and a journal."""
    writer = TableWriter(tmp_path, TABLE, disk=KillingDisk())
    for first in range(0, 150, 5):
        writer.add_rows(batch_of(range(first, first + 5), STEP_S))
        writer.sync_rows()
        writer.seal_next()
    return tmp_path


def _counts(run_dir: Path, notes: list[str]) -> list[int]:
    """The counts of all readable rows; all their values are right."""
    found: list[int] = []
    for table in TableReader(run_dir, TABLE, notes).iterate_tables():
        counts = table.column("count").to_pylist()
        expected = batch_of(counts, STEP_S)
        for name in table.column_names:
            assert repr(table.column(name).to_pylist()) == repr(
                expected.column(name).to_pylist()
            ), name
        found += counts
    return found


def _part(run_dir: Path, number: int) -> Path:
    return spec.part_path(run_dir / TABLE.name, number)


def test_an_intact_table_has_nothing_to_note(run_dir: Path) -> None:
    notes: list[str] = []
    reader = TableReader(run_dir, TABLE, notes)
    reader.note_missing(3)
    reader.check_all()
    assert _counts(run_dir, notes) == list(range(150))
    assert notes == []
    metadata = pq.read_metadata(_part(run_dir, 0))
    assert [metadata.row_group(n).num_rows for n in range(3)] == [20, 20, 20]


def test_any_flipped_byte_of_a_part_costs_its_row_group_at_most(run_dir: Path) -> None:
    path = _part(run_dir, 0)
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    for place in rng.permutation(len(whole))[:120]:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        notes: list[str] = []
        found = _counts(run_dir, notes)
        lost = sorted(set(range(150)) - set(found))
        assert lost in ([], [*range(20)], [*range(20, 40)], [*range(40, 60)]), place
        assert found == [count for count in range(150) if count not in lost]
        if lost:
            assert (
                f"rows from {lost[0] * STEP_S:.2f} s to {lost[-1] * STEP_S:.2f} s are left out"
                in notes[0]
            )
        TableReader(run_dir, TABLE, notes).check_all()
        assert any("SHA-256" in note for note in notes), (
            "the check of everything finds what reading does not need"
        )


def test_a_damaged_column_costs_nothing_of_the_others(run_dir: Path) -> None:
    path = _part(run_dir, 0)
    start, _ = chunk_span(pq.read_metadata(path).row_group(1).column(2))
    data = bytearray(path.read_bytes())
    data[start + 30] ^= 1
    path.write_bytes(data)
    notes: list[str] = []
    tables = list(TableReader(run_dir, TABLE, notes).iterate_tables(["count"]))
    assert sum(table.num_rows for table in tables) == 150
    assert notes == []


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_part_keeps_its_whole_row_groups(run_dir: Path, share: float) -> None:
    path = _part(run_dir, 0)
    whole = path.read_bytes()
    os.truncate(path, int(share * len(whole)))
    notes: list[str] = []
    found = _counts(run_dir, notes)
    assert found[-90:] == [*range(60, 150)]
    assert len(found) - 90 in (0, 20, 40, 60)
    assert "footer" in notes[0]
    if share == 0.999:
        assert found == [*range(150)]


def test_a_missing_part_is_named_with_its_times(run_dir: Path) -> None:
    _part(run_dir, 1).unlink()
    notes: list[str] = []
    assert _counts(run_dir, notes) == [*range(60), *range(120, 150)]
    TableReader(run_dir, TABLE, notes).note_missing(4)
    assert notes == [
        "numbers/numbers-0001.parquet: missing; rows from 3600.00 s to 7140.00 s are left out",
        "numbers/numbers-0003.parquet: missing; its rows are left out",
    ]


def test_any_damage_of_the_manifest_costs_no_rows(run_dir: Path) -> None:
    path = run_dir / TABLE.name / spec.MANIFEST
    whole = path.read_bytes()
    for place in range(0, len(whole), 101):
        damaged = bytearray(whole)
        damaged[place] ^= 4
        path.write_bytes(damaged)
        assert _counts(run_dir, []) == [*range(150)]
    path.unlink()
    assert _counts(run_dir, []) == [*range(150)]


def test_without_a_manifest_page_checksums_still_find_damage(run_dir: Path) -> None:
    (run_dir / TABLE.name / spec.MANIFEST).unlink()
    path = _part(run_dir, 0)
    start, size = chunk_span(pq.read_metadata(path).row_group(1).column(0))
    data = bytearray(path.read_bytes())
    data[start + size - 3] ^= 1
    path.write_bytes(data)
    notes: list[str] = []
    assert _counts(run_dir, notes) == [*range(20), *range(40, 150)]
    assert notes[0].endswith("is damaged)") or "CRC" in notes[0]


def test_any_flipped_byte_of_a_journal_costs_its_frame(run_dir: Path) -> None:
    path = spec.journal_path(run_dir / TABLE.name, 2)
    whole = path.read_bytes()
    frames = journal.find_frames(whole)
    for place in range(0, len(whole), 29):
        damaged = bytearray(whole)
        damaged[place] ^= 16
        path.write_bytes(damaged)
        hit = next(number for number, frame in enumerate(frames) if place < frame.end)
        lost = [*range(115 + 5 * hit, 120 + 5 * hit)] if hit else []
        notes: list[str] = []
        assert _counts(run_dir, notes) == [count for count in range(150) if count not in lost]
        assert notes[0].startswith("numbers/numbers-0002.journal: ")


def test_damage_of_a_journal_is_kept_in_the_manifest(run_dir: Path) -> None:
    path = spec.journal_path(run_dir / TABLE.name, 2)
    whole = bytearray(path.read_bytes())
    whole[journal.find_frames(bytes(whole))[3].start + 40] ^= 1
    path.write_bytes(whole)
    TableWriter(run_dir, TABLE, resumed=True, disk=KillingDisk()).close()
    notes: list[str] = []
    assert len(_counts(run_dir, notes)) == 145
    assert "its journal was damaged" in notes[0]


def test_a_part_of_a_run_reads_only_its_row_groups(run_dir: Path) -> None:
    reader = TableReader(run_dir, TABLE, [])
    for start_s, end_s in (
        (0.0, 1.0),
        (1190.0, 1210.0),
        (3599.0, 3601.0),
        (-5.0, 0.0),
        (8940.0, 1e9),
        (9e9, 1e10),
    ):
        found = [
            c
            for table in reader.iterate_tables(["count"], start_s, end_s)
            for c in table["count"].to_pylist()
        ]
        assert found == [count for count in range(150) if start_s <= count * STEP_S < end_s]


def test_a_month_is_read_a_row_group_at_a_time(run_dir: Path) -> None:
    sizes = [table.num_rows for table in TableReader(run_dir, TABLE, []).iterate_tables()]
    assert max(sizes) <= 20
    assert TableReader(run_dir, TABLE, []).read_newest("count").as_py() == 149


def test_the_bits_of_nan_and_missing_values_stay_distinct(tmp_path: Path) -> None:
    odd_nan = np.uint64(0xFFF8000000000123).view(np.float64)
    values = pa.array(
        np.array([1.0, np.nan, odd_nan, -0.0]), mask=np.array([False, False, False, False])
    )
    table = spec.TableSpec(
        "t", pa.schema([("time_s", pa.float64()), ("x", pa.float64())]), "time_s"
    )
    writer = TableWriter(tmp_path, table)
    writer.add_rows(pa.record_batch([pa.array([0.0, 1.0, 2.0, 3.0]), values], schema=table.schema))
    writer.add_rows(
        pa.record_batch([pa.array([4.0]), pa.array([None], pa.float64())], schema=table.schema)
    )
    writer.sync_rows()
    for _ in range(2):
        read = (
            pa.concat_tables(TableReader(tmp_path, table, []).iterate_tables())
            .column("x")
            .combine_chunks()
        )
        bits = np.frombuffer(read.buffers()[1], np.uint64)[:4]
        assert bits.tolist() == np.asarray(values.to_numpy()).view(np.uint64).tolist()
        assert read.null_count == 1
        writer.close()


def test_units_and_descriptions_are_in_the_fields(run_dir: Path) -> None:
    assert pq.read_schema(_part(run_dir, 0)).field("time_s").metadata[b"unit"] == b"s"


def _replace_part(run_dir: Path, **options: object) -> Path:
    """Forge the first part: with the columns of the table, but written by another program."""
    path = _part(run_dir, 0)
    (run_dir / TABLE.name / spec.MANIFEST).unlink()
    table = pa.Table.from_batches([batch_of(range(60), STEP_S)])
    pq.write_table(table, path, **options)  # type: ignore[arg-type]
    return path


def test_parts_of_other_writers_are_read(run_dir: Path) -> None:
    _replace_part(run_dir, compression="snappy", data_page_version="2.0", write_page_index=True)
    assert _counts(run_dir, []) == [*range(150)]


def test_a_link_in_place_of_a_part_is_not_followed(run_dir: Path, tmp_path: Path) -> None:
    path = _part(run_dir, 0)
    elsewhere = tmp_path / "elsewhere"
    path.rename(elsewhere)
    path.symlink_to(elsewhere)
    notes: list[str] = []
    assert _counts(run_dir, notes) == [*range(60, 150)]
    assert "link" in notes[0]


def test_a_pipe_in_place_of_a_journal_does_not_block(run_dir: Path) -> None:
    path = spec.journal_path(run_dir / TABLE.name, 2)
    path.unlink()
    os.mkfifo(path)
    notes: list[str] = []
    assert _counts(run_dir, notes) == [*range(120)]
    assert "not a plain file" in notes[0]


def test_columns_of_another_type_are_not_read(run_dir: Path) -> None:
    (run_dir / TABLE.name / spec.MANIFEST).unlink()
    table = pa.Table.from_batches([batch_of(range(60), STEP_S)])
    table = table.set_column(2, "value", pa.array(["x"] * 60)).append_column(
        "more", pa.array([[1]] * 60)
    )
    pq.write_table(table, _part(run_dir, 0))
    notes: list[str] = []
    tables = list(TableReader(run_dir, TABLE, notes).iterate_tables())
    assert "value" not in tables[0].column_names
    assert "more" not in tables[0].column_names
    assert notes == ["numbers/numbers-0000.parquet: without value"]


def test_repeated_texts_take_no_memory(run_dir: Path) -> None:
    """30 kB of Parquet that would be 60 GB of text."""
    (run_dir / TABLE.name / spec.MANIFEST).unlink()
    rows = 60_000
    words = pa.DictionaryArray.from_arrays(
        pa.array(np.zeros(rows, np.int32)), pa.array(["x" * 1_000_000])
    )
    batch = pa.Table.from_batches([batch_of(range(rows), 0.05)]).set_column(4, "word", words)
    pq.write_table(batch, _part(run_dir, 0), use_dictionary=["word"], compression="zstd")
    notes: list[str] = []
    assert (
        sum(table.num_rows for table in TableReader(run_dir, TABLE, notes).iterate_tables()) == 90
    )
    assert "more text than a recorder writes" in notes[0]


def test_pages_that_claim_gigabytes_are_refused(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _replace_part(run_dir, compression="zstd", use_dictionary=False)
    monkeypatch.setattr("membrane_ctrl.run_files.table_store.part_reader.CHUNK_BYTES_MAX", 479)
    notes: list[str] = []
    assert _counts(run_dir, notes) == [*range(60, 150)]
    assert "larger than a recorder writes" in notes[0]
    found = page_headers.measure_chunk(
        b"\x15\x00\x15\xfe\xff\xff\xff\x0f\x15\x02\x2c\x15\x78\x00\x00x"
    )
    assert found == page_headers.ChunkSize(2**31 - 1, 60)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x15",
        b"\xff" * 40,
        b"\x15\x00",
        b"\x1c" * 60,
        b"\x19\xf4" + b"\xff" * 9,
        b"\x15" + b"\xff" * 30,
    ],
)
def test_page_headers_of_any_bytes_are_refused(data: bytes) -> None:
    if not data:
        assert page_headers.measure_chunk(data).values == 0
        return
    with pytest.raises(ValueError, match="page"):
        page_headers.measure_chunk(data)


def test_the_header_walk_agrees_with_arrow(run_dir: Path) -> None:
    path = _part(run_dir, 0)
    metadata, data = pq.read_metadata(path), path.read_bytes()
    for group in range(3):
        for column in range(metadata.num_columns):
            chunk = metadata.row_group(group).column(column)
            start, size = chunk_span(chunk)
            found = page_headers.measure_chunk(data[start : start + size])
            assert found.values == chunk.num_values
            assert found.unpacked_bytes < chunk.total_uncompressed_size


def _forged_journal(run_dir: Path, rows: int, unpacked_bytes: int, message: bytes) -> None:
    """Append a frame with a right checksum to the journal."""
    path = spec.journal_path(run_dir / TABLE.name, 2)
    packed = pa.Codec("zstd").compress(message, asbytes=True)
    head = struct.pack("<8sQIII", journal.MAGIC, 150, rows, len(packed), unpacked_bytes)
    crc = zlib.crc32(packed, zlib.crc32(head))
    path.write_bytes(path.read_bytes() + head + struct.pack("<I", crc) + packed)


@pytest.mark.parametrize("unpacked_bytes", [0, 5, (1 << 32) - 1, journal.FRAME_BYTES_MAX])
def test_forged_frames_are_left_out(run_dir: Path, unpacked_bytes: int) -> None:
    _forged_journal(run_dir, 5, unpacked_bytes, b"no message")
    notes: list[str] = []
    assert _counts(run_dir, notes) == [*range(150)]
    assert "no intact rows" in notes[0]


def test_compressed_buffers_in_a_frame_are_refused(run_dir: Path) -> None:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(
        sink, TABLE.schema, options=pa.ipc.IpcWriteOptions(compression="zstd")
    ) as stream:
        stream.write_batch(batch_of(range(150, 155), STEP_S))
    reader = pa.ipc.MessageReader.open_stream(sink.getvalue())
    reader.read_next_message()
    message = reader.read_next_message().serialize().to_pybytes()
    _forged_journal(run_dir, 5, len(message), message)
    notes: list[str] = []
    assert _counts(run_dir, notes) == [*range(150)]
    assert "no intact rows" in notes[0]


def test_frames_within_frames_end_the_search(run_dir: Path) -> None:
    head = struct.pack("<8sQIIII", journal.MAGIC, 0, 1, 200_000, 10, 0)
    assert journal.find_frames(head * 20_000) == []


def test_a_manifest_of_nonsense_is_left_out(run_dir: Path) -> None:
    path = run_dir / TABLE.name / spec.MANIFEST
    path.write_text('{"number": 0}\n[1]\nnull\n{"number": -1, "groups": []}\n\n')
    notes: list[str] = []
    assert read_manifest(path.parent, notes) == {}
    assert notes == ["numbers/manifest.jsonl: 4 damaged lines are left out"]
    assert _counts(run_dir, []) == [*range(150)]


def test_names_that_are_no_files_of_the_table_are_ignored(run_dir: Path) -> None:
    folder = run_dir / TABLE.name
    for name in (
        "other-0000.parquet",
        "numbers-1.parquet",
        "numbers-.parquet",
        "numbers-0000.part",
        "a-b",
    ):
        (folder / name).write_bytes(b"x")
    assert _counts(run_dir, []) == [*range(150)]


def test_read_counts_compares_every_value(tmp_path: Path) -> None:
    writer = TableWriter(tmp_path, TABLE)
    writer.add_rows(batch_of([1, 2]))
    writer.close()
    assert read_counts(tmp_path) == [1, 2]
