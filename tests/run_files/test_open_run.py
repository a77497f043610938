"""Reading runs back: the record, and the remains of runs that ended badly."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.telemetry import FIELDS, get_column
from membrane_ctrl.review import open_run
from membrane_ctrl.run_files.levels import (
    CODES,
    NAMES,
    SIGNALS,
    SPREAD_SIGNALS,
    TICK_FIELDS,
    coarser_level,
    first_level,
)
from membrane_ctrl.run_files.table_store.spec import PART_S
from tests.support.review_runs import same, set_summary, tables, written
from tests.worlds.nights import night


def level_of(rows: np.ndarray) -> dict[str, np.ndarray]:
    return first_level({name: get_column(rows, name) for name in TICK_FIELDS})


def test_every_field_comes_back(tmp_path: Path) -> None:
    rows, shapes = night(1, 0.1, "typical", [])
    table = open_run(written(tmp_path, 0.1)).ticks()
    assert table.column_names == ["time_s", "time_utc", *FIELDS[1:]]
    for name in {*FIELDS[1:]} - {*CODES}:
        assert same(table.column(name).to_numpy(), get_column(rows, name), 1e-4), name
    back = open_run(tmp_path / "20261121T180000Z-night").shapes()
    np.testing.assert_allclose(back.coeffs_um, [shape.coeffs_um for shape in shapes])
    np.testing.assert_allclose(back.covariance_um2[0], shapes[0].covariance_um2, rtol=1e-6)


def test_a_part_of_a_run(tmp_path: Path) -> None:
    table = open_run(written(tmp_path, 0.1)).ticks(["error_um"], 100.0, 110.0)
    time_s = table.column("time_s").to_numpy()
    assert table.column_names == ["time_s", "time_utc", "error_um"]
    assert (time_s[0] >= 100, time_s[-1] < 110, table.num_rows) == (True, True, 100)


def test_an_unknown_column_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="eror_um"):
        open_run(written(tmp_path, 0.02)).ticks(["eror_um"])


@pytest.mark.parametrize("window_s", [1.0, 10.0, 60.0])
def test_levels_are_least_mean_and_greatest_of_their_windows(
    tmp_path: Path, window_s: float
) -> None:
    rows, _ = night(1, 0.1, "typical", [])
    level = open_run(written(tmp_path, 0.1)).level(window_s)
    number = np.floor(get_column(rows, "mono_s") / window_s)
    pressure = get_column(rows, "ambient_pressure_pa")
    for k in (0, level["time_s"].size // 2, level["time_s"].size - 1):
        inside = pressure[number == level["time_s"][k] / window_s]
        assert level["rows"][k] == inside.size
        found = [level[f"{kind}_ambient_pressure_pa"][k] for kind in ("min", "mean", "max")]
        np.testing.assert_allclose(found, [inside.min(), inside.mean(), inside.max()], atol=1e-5)


def test_a_level_of_a_level_is_the_level_of_the_ticks() -> None:
    rows, _ = night(2, 0.1, "typical", [])
    fine = level_of(rows)
    coarse = coarser_level(coarser_level(fine, 10.0), 60.0)
    direct = coarser_level(fine, 60.0)
    for name in NAMES:
        assert same(coarse[name], direct[name], 1e-9), name


@pytest.mark.parametrize("window_s", [1.0, 10.0, 60.0])
def test_a_window_has_the_standard_deviation_of_its_ticks(window_s: float) -> None:
    rows, _ = night(2, 0.1, "typical", [])
    time_s, error_um = get_column(rows, "mono_s"), get_column(rows, "error_um")
    error_um[7] = np.nan  # a missing reading
    level = coarser_level(coarser_level(level_of(rows), 10.0), 60.0)
    if window_s < 60.0:
        level = coarser_level(level_of(rows), window_s)
    number = np.floor(time_s / window_s + 1e-9)
    expected_um = [np.nanstd(error_um[number == each]) for each in np.unique(number)]
    # The missing reading is one tick of the first windows' weights.
    np.testing.assert_allclose(level["std_error_um"], expected_um, rtol=1e-2)
    np.testing.assert_allclose(level["std_error_um"][1:], expected_um[1:], rtol=1e-9)


def test_a_standard_deviation_is_made_where_its_level_is_missing(tmp_path: Path) -> None:
    folder = written(tmp_path, 0.1)
    whole = open_run(folder).level(60.0, names=["std_error_um"])
    shutil.rmtree(folder / "ticks_60s")
    shutil.rmtree(folder / "ticks_10s")
    made = open_run(folder).level(60.0, names=["std_error_um"])
    np.testing.assert_allclose(made["std_error_um"], whole["std_error_um"], rtol=1e-4)


def test_nothing_finite_gives_nan_and_no_warning() -> None:
    rows, _ = night(2, 0.01, "typical", [])
    rows[:, FIELDS.index("trim_um")] = np.nan
    level = level_of(rows)
    assert np.isnan(level["mean_trim_um"]).all()
    assert np.isfinite(level["mean_error_um"]).all()
    assert set(level) == set(NAMES)
    assert len(SIGNALS) * 3 + len(SPREAD_SIGNALS) + 6 == len(NAMES)


def test_a_killed_run_is_whole_in_its_tables(tmp_path: Path) -> None:
    rows, shapes = night(3, 0.05, "typical", [])
    tables(tmp_path, rows, shapes, close=False)
    run = open_run(tmp_path)
    assert run.ticks().num_rows == len(rows)
    assert run.level(60.0)["rows"].sum() == len(rows)
    assert len(run.shapes()) == len(shapes)
    files = {path.name for path in tmp_path.rglob("*-0000.*")}
    assert {"ticks-0000.journal", "shapes-0000.journal", "ticks_1s-0000.journal"} <= files


@pytest.mark.parametrize("table", ["ticks_1s", "shapes"])
def test_a_missing_file_of_any_table_is_named(tmp_path: Path, table: str) -> None:
    folder = written(tmp_path, 0.02)
    (folder / table / f"{table}-0000.parquet").unlink()
    assert any(f"{table}-0000.parquet: missing" in note for note in open_run(folder).notes)


def test_a_run_without_its_table_of_ticks_has_a_note(tmp_path: Path) -> None:
    folder = written(tmp_path, 0.02)
    shutil.rmtree(folder / "ticks")
    run = open_run(folder)
    assert "the table of ticks is missing" in run.notes
    assert run.ticks().num_rows == 0
    assert run.level(1.0)["rows"].sum() > 0


def test_a_torn_table_gives_what_is_whole(tmp_path: Path) -> None:
    folder = written(tmp_path, 0.2)
    path = folder / "ticks" / "ticks-0000.parquet"
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    run = open_run(folder)
    assert run.ticks(["error_um"]).num_rows == 7200, "its column lies in the first two thirds"
    assert run.ticks().num_rows == 0
    assert any(
        "ticks-0000.parquet: rows from 0.00 s to 719.90 s are left out" in note
        for note in run.notes
    )


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    folder = written(tmp_path, 0.05)
    (folder / "ticks" / "ticks-0000.parquet").write_bytes(b"\xff" * 4000)
    run = open_run(folder)
    assert run.ticks().num_rows == 0
    assert any("ticks-0000.parquet: its footer is damaged" in note for note in run.notes)
    assert run.level(1.0)["time_s"].size > 0


def test_a_missing_file_is_named_and_the_rest_is_there(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    one, _ = night(5, 0.02, "typical", [])
    parts = [one.copy() for _ in range(3)]
    for number, part in enumerate(parts):
        part[:, FIELDS.index("mono_s")] += 1.1 * PART_S * number
    rows = np.concatenate(parts)
    tables(folder, rows, [])
    assert len(list((folder / "ticks").glob("ticks-*"))) == 3
    (folder / "ticks" / "ticks-0001.parquet").unlink()
    run = open_run(folder)
    assert any("ticks-0001.parquet: missing" in note for note in run.notes)
    assert run.ticks(["error_um"]).num_rows == len(rows) * 2 // 3


def test_broken_small_files_are_named(tmp_path: Path) -> None:
    folder = written(tmp_path, 0.02)
    with (folder / "events.jsonl").open("a") as file:
        file.write('{"kind": "half')
    (folder / "config.toml").write_text(
        "[loop]\nrate_hz = 10.0\n[limits]\nband_um = 3.0\n[unheard_of]\nx = 1\n"
    )
    (folder / "summary.json").write_text("not json")
    run = open_run(folder)
    assert run.config.limits.band_um == 3.0
    assert run.summary is None
    assert {note.split(":")[0] for note in run.notes} >= {
        "events.jsonl",
        "config.toml",
        "summary.json",
    }


def test_another_schema_is_reported(tmp_path: Path) -> None:
    folder = written(tmp_path, 0.02)
    set_summary(folder, schema="membrane-summary/0")
    assert any("membrane-summary/2" in note for note in open_run(folder).notes)


@pytest.mark.parametrize("what", ["absent", "empty", "file"])
def test_what_is_no_run_is_refused(tmp_path: Path, what: str) -> None:
    path = tmp_path / what
    if what == "empty":
        path.mkdir()
    if what == "file":
        path = tmp_path / "sub" / "a.txt"
        path.parent.mkdir()
        path.write_text("x")
    with pytest.raises(InputError, match=what if what != "file" else "not a run"):
        open_run(path)
