"""A run's configuration that this version understands only in part, or that is missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.model.telemetry import COLUMN
from membrane_ctrl.review import open_run
from membrane_ctrl.review.statistics.analysis import analyse_run
from membrane_ctrl.run_files.recorded_rate import recorded_rate_hz
from membrane_ctrl.run_files.run_config import keep_understood
from tests.support.review_runs import tables, written
from tests.worlds.nights import night

HOURS = 0.05


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("config"), HOURS)


def test_an_unknown_key_does_not_take_its_table_along(folder: Path) -> None:
    path = folder / "config.toml"
    text = path.read_text()
    path.write_text(
        text.replace("[loop]", "[loop]\nold_option = 1").replace(
            "kp_per_s = 0.61", "kp_per_s = 0.5"
        )
    )
    run = open_run(folder)
    path.write_text(text)
    assert run.config.loop.rate_hz == 10.0
    assert run.config.loop.kp_per_s == 0.5
    assert [note for note in run.notes if "loop.old_option" in note] == run.notes


def test_values_that_cannot_be_are_at_their_defaults_one_by_one() -> None:
    tables = {
        "loop": {"rate_hz": 10.0, "kp_per_s": -1.0, "ti_s": 9.0},
        "limits": {"band_um": 3.0, "older": {"a": 1}},
        "pump": 7,
        "gone": [{"x": 1}],
    }
    config, left_out = keep_understood(tables)
    assert sorted(left_out) == ["gone", "limits.older", "loop.kp_per_s", "pump"]
    assert (config.loop.rate_hz, config.loop.ti_s, config.limits.band_um) == (10.0, 9.0, 3.0)
    assert tables["pump"] == 7


@pytest.mark.parametrize("text", [None, "", "[loop]\nrate_hz = 50.0\n"])
def test_the_rate_is_that_of_the_ticks(folder: Path, text: str | None) -> None:
    right = analyse_run(open_run(folder))
    path = folder / "config.toml"
    kept = path.read_text()
    path.unlink()
    if text is not None:
        path.write_text(text)
    run = open_run(folder)
    path.write_text(kept)
    assert any("ticks at 10 Hz" in note for note in run.notes)
    found = analyse_run(run)
    assert found.ticks.hold_s == pytest.approx(HOURS * 3600, abs=1)
    assert found.reading is not None
    assert right.reading is not None
    assert np.array_equal(found.reading.allan.tau_s, right.reading.allan.tau_s)
    assert found.reading.windows == right.reading.windows


def test_without_ticks_the_seconds_give_the_rate(tmp_path: Path) -> None:
    folder = written(tmp_path, HOURS)
    assert recorded_rate_hz(folder) == 10.0
    for path in (folder / "ticks").glob("ticks*"):
        path.unlink()
    assert recorded_rate_hz(folder) == 10.0
    assert recorded_rate_hz(tmp_path) is None


def test_late_ticks_are_no_other_rate(tmp_path: Path) -> None:
    """Where a sleep ends up to a fifth of a period late, most ticks are farther apart than the
    period.
    """
    rows, _ = night(1, 0.01, "quiet", [])
    late_ms = np.arange(len(rows)) * 0.7 % 2.0 * 10
    rows[:, COLUMN["mono_s"]] = 0.1 * np.arange(len(rows)) + 1e-3 * late_ms
    rows[:, COLUMN["lateness_ms"]] = late_ms
    rows[1:, COLUMN["dt_s"]] = np.diff(rows[:, COLUMN["mono_s"]])
    assert np.median(rows[:, COLUMN["dt_s"]]) > 0.105
    tables(tmp_path, rows, [])
    assert recorded_rate_hz(tmp_path) == 10.0
