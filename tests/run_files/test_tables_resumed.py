"""Tables left by a killed recorder and continued by the next one: every row once."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from membrane_ctrl.model.telemetry import Rows, unpack_rows
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.run_files.run_tables import RunTables
from tests.worlds.nights import batch_of
from tests.worlds.synthetic_run import rows_of, shape_of

ROWS: Rows = unpack_rows([row.pack() for row in rows_of(200.0)])
SECONDS = range(200)
KILLED = (3, 61, 62, 150)  # twice in a row among them


def second(number: int) -> Rows:
    return ROWS[50 * number : 50 * number + 50]


def ticks_of(folder: Path) -> np.ndarray:
    (folder / "events.jsonl").touch()
    found: np.ndarray = open_run(folder).ticks(["tick"]).column("tick").to_numpy()
    return found


def feed(tables: RunTables, number: int) -> None:
    tables.add_ticks(batch_of(second(number)))
    tables.add_shape(shape_of(float(number), number))
    tables.sync_tables()


@pytest.mark.parametrize("repeated", [0, 1], ids=["the state was newer", "the state was older"])
def test_after_four_deaths_every_tick_window_and_shape_is_there_once(
    tmp_path: Path, repeated: int
) -> None:
    tables = RunTables(tmp_path)
    handed_on = deepcopy(tables.open_windows)
    for number in SECONDS:
        feed(tables, number)
        if number in KILLED:
            if not repeated:
                handed_on = deepcopy(tables.open_windows)
            tables = RunTables(tmp_path, resumed=handed_on)
            if repeated:
                feed(tables, number)
        handed_on = deepcopy(tables.open_windows)
    tables.close()
    assert np.array_equal(ticks_of(tmp_path), ROWS[:, 1])
    run = open_run(tmp_path)
    for window_s in (1.0, 10.0, 60.0):
        level = run.level(window_s)
        assert (np.diff(level["time_s"]) == window_s).all()
        assert level["rows"].sum() == len(ROWS)
    assert np.array_equal(run.shapes().time_s, np.array(SECONDS, dtype=float))
    parts = sorted((tmp_path / "figures_60s").glob("*.parquet"))
    minutes = pa.concat_tables(pq.read_table(part) for part in parts)
    assert minutes.column("time_s").to_pylist() == [0.0, 60.0, 120.0, 180.0]
    assert minutes.column("figures").to_pylist() == [60, 60, 60, 20]
    assert not list(tmp_path.rglob("*.journal"))


def test_what_is_added_is_on_the_disk_each_second(tmp_path: Path) -> None:
    tables = RunTables(tmp_path)
    for number in range(5):
        feed(tables, number)
        assert len(ticks_of(tmp_path)) == 50 * (number + 1)


def test_of_a_torn_journal_the_whole_frames_are_taken_over(tmp_path: Path) -> None:
    tables = RunTables(tmp_path)
    for number in range(10):
        feed(tables, number)
    journal = tmp_path / "ticks" / "ticks-0000.journal"
    journal.write_bytes(journal.read_bytes()[:-100])
    again = RunTables(tmp_path, resumed=tables.open_windows)
    feed(again, 10)
    again.close()
    assert np.array_equal(ticks_of(tmp_path), np.delete(ROWS[:550, 1], slice(450, 500)))
