"""A growing table, read row by row: every row once and in order, whatever becomes of its files."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from membrane_ctrl.run_files.table_store import spec
from membrane_ctrl.run_files.table_store.follower import TableFollower
from membrane_ctrl.run_files.table_store.spec import TableSpec
from membrane_ctrl.run_files.table_store.writer import TableWriter

TABLE = TableSpec(
    "things", pa.schema([("time_s", pa.float64()), ("number", pa.int64())]), "time_s", 40
)


def add(writer: TableWriter, first: int, count: int = 10) -> None:
    numbers = np.arange(first, first + count)
    columns = [pa.array(numbers * 1.0), pa.array(numbers)]
    writer.add_rows(pa.record_batch(columns, schema=TABLE.schema))
    writer.sync_rows()


def read(follower: TableFollower) -> list[int]:
    return [number for table in follower.read_new() for number in table.column(1).to_pylist()]


def test_each_row_is_read_once_while_journals_become_parts(tmp_path: Path) -> None:
    table = replace(TABLE, part_s=30.0)
    writer, follower = TableWriter(tmp_path, table), TableFollower(tmp_path, table)
    assert read(follower) == []
    found: list[int] = []
    for step in range(30):
        add(writer, 10 * step)
        if step % 7 == 3:
            writer.seal_next()
        if step % 3 != 1:
            found += read(follower)
    writer.close()
    found += read(follower)
    assert found == list(range(300))
    assert read(follower) == []


def test_only_new_frames_of_the_journal_are_read(tmp_path: Path) -> None:
    writer, follower = TableWriter(tmp_path, TABLE), TableFollower(tmp_path, TABLE)
    add(writer, 0)
    read(follower)
    add(writer, 10)
    assert read(follower) == list(range(10, 20))
    path = spec.journal_path(tmp_path / "things", 0)
    before = path.read_bytes()
    path.write_bytes(bytes(len(before)))  # what was read is not read again
    add(writer, 20)
    assert read(follower) == list(range(20, 30))


def test_half_a_frame_is_read_when_it_is_whole(tmp_path: Path) -> None:
    writer, follower = TableWriter(tmp_path, TABLE), TableFollower(tmp_path, TABLE)
    add(writer, 0)
    read(follower)
    add(writer, 10)
    path = spec.journal_path(tmp_path / "things", 0)
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    assert read(follower) == []
    path.write_bytes(whole)
    assert read(follower) == list(range(10, 20))


def test_earlier_rows_are_left_out(tmp_path: Path) -> None:
    writer = TableWriter(tmp_path, TABLE)
    add(writer, 0, 100)
    assert read(TableFollower(tmp_path, TABLE, after=94.0)) == [95, 96, 97, 98, 99]


def test_a_journal_with_other_columns_is_left_out(tmp_path: Path) -> None:
    follower = TableFollower(tmp_path, TABLE)
    read(follower)
    other = TableSpec("things", pa.schema([("time_s", pa.float64())]), "time_s")
    writer = TableWriter(tmp_path, other)
    writer.add_rows(pa.record_batch([pa.array([1.0, math.inf])], schema=other.schema))
    writer.sync_rows()
    assert read(follower) == []
