"""A review has the thumbnails of a run without its Rerun recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from membrane_ctrl.model.telemetry import unpack_rows
from membrane_ctrl.review import open_run
from membrane_ctrl.review.viewer.command import ReviewOptions, make_review
from membrane_ctrl.run_files.run import Run
from membrane_ctrl.run_files.run_folder import create_run_folder
from membrane_ctrl.run_files.run_tables import RunTables
from tests.support.rrd_reading import entities, reader
from tests.worlds.nights import CONFIG, batch_of
from tests.worlds.synthetic_run import STARTED_UTC, rows_of

PATTERNS = ("x_sin_0", "y_sin_0")
SETS = 30


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """30 s with a set of two pictures a second."""
    folder = create_run_folder(tmp_path, "night", STARTED_UTC, CONFIG)
    tables = RunTables(folder, STARTED_UTC)
    tables.add_ticks(batch_of(unpack_rows([row.pack() for row in rows_of(float(SETS))])))
    for number in range(SETS):
        for pattern in PATTERNS:
            tables.add_thumbnail(number + 0.5, pattern, f"{pattern} {number}".encode())
    tables.close()
    (folder / "events.jsonl").touch()
    return open_run(folder)


def test_they_are_evenly_spaced_for_each_pattern(run: Run) -> None:
    found = run.thumbnails(10)
    for pattern in PATTERNS:
        times_s = [each["time_s"] for each in found if each["pattern"] == pattern]
        assert times_s == [3.0 * k + 0.5 for k in range(10)]
    assert found[0] == {"time_s": 0.5, "pattern": "x_sin_0", "jpeg": b"x_sin_0 0"}


def test_a_part_has_its_own(run: Run) -> None:
    found = run.thumbnails(100, 4.0, 6.0)
    assert [(each["time_s"], each["pattern"]) for each in found] == [
        (moment_s, pattern) for moment_s in (4.5, 5.5) for pattern in PATTERNS
    ]
    assert run.thumbnails(100, 500.0, 600.0) == []


def test_a_run_without_thumbnails_has_none(tmp_path: Path) -> None:
    folder = create_run_folder(tmp_path, "night", STARTED_UTC, CONFIG)
    (folder / "events.jsonl").touch()
    assert open_run(folder).thumbnails(10) == []


def test_the_review_shows_them(run: Run, tmp_path: Path) -> None:
    assert not list(run.folder.glob("*.rrd"))
    file = tmp_path / "review.rrd"
    make_review([run], ReviewOptions([run.folder], tab="frames"), file)
    assert {"/frames/x_sin_0", "/frames/y_sin_0"} <= entities(file)
    chunks = reader(file).stream().filter(content="/frames/x_sin_0")
    pictures = sum(chunk.to_record_batch().num_rows for chunk in chunks)
    assert pictures == SETS
