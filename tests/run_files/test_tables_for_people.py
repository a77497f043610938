"""Runs as tables for people: UTC, names, nulls."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pytest

from membrane_ctrl.model.telemetry import FIELDS, SafeLevel, State
from membrane_ctrl.review import open_run
from membrane_ctrl.review.export import export_run
from membrane_ctrl.run_files.named_tables import named_table
from membrane_ctrl.run_files.run import Run
from tests.support.review_runs import tables
from tests.worlds.nights import night

ORIGIN = datetime(2026, 11, 21, 18, 0, 0, 250_000, tzinfo=UTC)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with all that a table translates: states, a fault, an unknown code, missing values."""
    rows, shapes = night(1, 0.03, "typical", [])
    rows[:300, FIELDS.index("state")] = State.SETTLE
    rows[500:, FIELDS.index("state")] = State.FAULT
    rows[500:, FIELDS.index("safe_level")] = SafeLevel.PUMP_OFF
    rows[500:, FIELDS.index("fault")] = 30.0
    rows[600:, FIELDS.index("fault")] = 99.0
    rows[100:200, FIELDS.index("displacement_um")] = np.nan
    rows[:, FIELDS.index("trim_um")] = np.nan
    rows[:, FIELDS.index("sample_counter")] = np.nan
    path = tmp_path_factory.mktemp("named")
    tables(path, rows, shapes)
    return path


def test_codes_are_names(folder: Path) -> None:
    ticks = open_run(folder).ticks()
    rows = {
        row: {
            name: ticks.column(name)[row].as_py()
            for name in ("state", "shape_state", "safe_level", "fault")
        }
        for row in (0, 400, 550, 650)
    }
    assert rows[0] == {
        "state": "settle",
        "shape_state": "tracking",
        "safe_level": "none",
        "fault": "none",
    }
    assert (rows[400]["state"], rows[400]["fault"]) == ("hold", "none")
    assert rows[550] == {
        "state": "fault",
        "shape_state": "tracking",
        "safe_level": "pump_off",
        "fault": "link_lost",
    }
    assert rows[650]["fault"] == "code 99"  # of a later version


def test_absent_values_are_null_and_counts_are_integers(folder: Path) -> None:
    ticks = open_run(folder).ticks()
    assert [
        ticks.column(name).null_count for name in ("displacement_um", "trim_um", "setpoint_um")
    ] == [100, 1080, 0]
    assert ticks.column("displacement_um")[100].as_py() is None
    assert ticks.column("tick").type == ticks.column("sample_counter").type == pa.int64()
    assert ticks.column("sample_counter").null_count == ticks.num_rows
    level = open_run(folder).overview(10.0, names=["state", "mean_trim_um", "min_displacement_um"])
    assert level.column_names == [
        "time_s",
        "time_utc",
        "rows",
        "state",
        "mean_trim_um",
        "min_displacement_um",
    ]
    assert level.column("mean_trim_um").null_count == level.num_rows
    assert level.column("rows")[0].as_py() == 100
    assert level.column("state")[0].as_py() == "settle"


def _times(run: Run) -> list[pa.Table]:
    return [run.ticks(["error_um"]), run.overview(60.0), run.cycles()]


@pytest.mark.parametrize("place", [0, 1, 2])
def test_every_table_has_the_same_times(folder: Path, place: int) -> None:
    run = open_run(folder)
    table = _times(run)[place]
    assert table.column_names[:2] == ["time_s", "time_utc"]
    assert "mono_s" not in table.column_names
    for row in (0, -1):
        passed = table.column("time_utc")[row].as_py() - run.origin_utc
        assert passed / timedelta(seconds=1) == pytest.approx(
            table.column("time_s")[row].as_py(), abs=1e-6
        )


def test_an_impossible_time_has_no_utc() -> None:
    table = named_table({"time_s": np.array([0.5, np.nan, np.inf, 1e12])}, ORIGIN)
    assert [moment and moment.isoformat() for moment in table.column("time_utc").to_pylist()] == [
        "2026-11-21T18:00:00.750000+00:00",
        None,
        None,
        None,
    ]


def test_a_code_that_was_not_recorded_is_null() -> None:
    table = named_table({"mono_s": np.arange(3.0), "state": np.array([np.nan, 4.0, 0.0])}, ORIGIN)
    assert table.column("state").to_pylist() == [None, "hold", "standby"]


def test_a_part_without_data_has_the_same_columns(folder: Path) -> None:
    run = open_run(folder)
    for whole, none in (
        (run.ticks(), run.ticks(start_s=1e6)),
        (run.overview(), run.overview(start_s=1e6)),
        (run.cycles(), run.cycles(start_s=1e6)),
    ):
        assert none.column_names == whole.column_names
        assert none.num_rows == 0
        assert none.column("time_utc").type == pa.timestamp("us", "UTC")


def test_a_csv_has_words_and_empty_cells(folder: Path, tmp_path: Path) -> None:
    export_run(open_run(folder), "csv", tmp_path, ["state", "displacement_um", "shapes"])
    lines = (tmp_path / "ticks.csv").read_text().splitlines()
    assert lines[0] == '"time_s","time_utc","state","displacement_um"'
    assert lines[101].endswith('"settle",')
    read = pyarrow.csv.read_csv(tmp_path / "ticks.csv")
    assert read.column("time_utc").type == pa.timestamp("ns", "UTC")
    assert pyarrow.csv.read_csv(tmp_path / "shapes.csv").column_names[:3] == [
        "time_s",
        "time_utc",
        "z1_um",
    ]
