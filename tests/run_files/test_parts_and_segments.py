"""Which Rerun segments a part of a run reads: none that the tables replace, and none far away."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from benchmarks.nights import night
from membrane_ctrl.review import open_run
from membrane_ctrl.review.statistics.analysis import analyse
from membrane_ctrl.run_files import rrd_reader
from membrane_ctrl.run_files.rrd_reader import segment_blocks
from tests.support.review_runs import same, segment, set_summary, tables, written

HOURS = 0.1
SEGMENT_S = 60.0


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of the segments read: sixty of a minute, with a tick a second; the 10th and the 31st are broken."""
    found: list[int] = []

    def read_ticks(path: Path, names: Sequence[str], notes: list[str]) -> dict[str, np.ndarray]:
        number = int(path.stem[-3:])
        found.append(number)
        broken = number in {10, 31}
        if broken:
            notes.append(f"{path.name}: damaged")
        time_s = np.empty(0) if broken else SEGMENT_S * number + np.arange(SEGMENT_S)
        return dict.fromkeys(names, time_s)

    monkeypatch.setattr(rrd_reader, "read_ticks", read_ticks)
    return found


def _with_segments(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    for number in range(60):
        (folder / f"night-{number:03d}.rrd").touch()
    return folder


def test_what_the_tables_have_is_not_read_from_segments(tmp_path: Path, reads: list[int]) -> None:
    folder = _with_segments(written(tmp_path, HOURS))
    set_summary(folder, duration_s=HOURS * 3600)
    run = open_run(folder)
    whole = run.ticks(["error_um"])
    part = run.ticks(["error_um"], 60.0, 120.0)
    time_s = whole.column("time_s").to_numpy()
    inside = (time_s >= 60) & (time_s < 120)
    assert same(part.column("error_um").to_numpy(), whole.column("error_um").to_numpy()[inside], 0.0)
    for window_s in (1.0, 10.0, 60.0):
        level, of_part = run.level(window_s), run.level(window_s, 60.0, 125.0)
        there = (level["time_s"] >= 60) & (level["time_s"] < 125)
        assert same(of_part["mean_error_um"], level["mean_error_um"][there], 0.0)
    assert run.level(1.0, 1000.0, 1100.0)["time_s"].size == 0  # behind the end
    assert analyse(run, 60.0, 125.0).anomalies == ()
    assert reads == []


@pytest.mark.parametrize(("start_s", "end_s"), [(60.0, 120.0), (605.0, 700.0), (1860.0, 1990.0), (3500.0, 1e9)])
def test_only_segments_about_the_part_are_read(
    tmp_path: Path, reads: list[int], start_s: float, end_s: float
) -> None:
    folder = _with_segments(tmp_path / "run")
    notes: list[str] = []
    blocks = list(segment_blocks(folder, ["mono_s"], start_s, end_s, notes))
    time_s = np.concatenate([block["mono_s"] for block in blocks])
    every = np.concatenate([SEGMENT_S * n + np.arange(SEGMENT_S) for n in range(60) if n not in {10, 31}])
    assert np.array_equal(time_s, every[(every >= start_s) & (every < end_s)])
    assert len(reads) < 20
    # what is damaged elsewhere is nothing of this part
    assert notes == [f"night-{n:03d}.rrd: damaged" for n in (10, 31) if start_s < SEGMENT_S * (n + 1) <= end_s]


def test_a_part_in_a_hole_of_the_tables_comes_from_its_segment(tmp_path: Path) -> None:
    rows, _ = night(4, HOURS, "typical", [])
    lost = (rows[:, 0] >= 60) & (rows[:, 0] < 180)
    tables(tmp_path, rows[~lost], [])
    segment(tmp_path, rows[600:1200])
    run = open_run(tmp_path)
    found = run.ticks(["error_um"], 70.0, 110.0)
    assert found.num_rows == 400
    assert any("Rerun segments replace ticks" in note for note in run.notes)
    assert run.level(10.0, 70.0, 110.0)["time_s"].size == 4
