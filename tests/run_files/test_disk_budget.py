"""What is omitted when the disk runs low, and which old runs are deleted."""

from __future__ import annotations

import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from membrane_ctrl.config.schema import RecordingConfig
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.recorder_events import RecorderError, RecorderRecovered
from membrane_ctrl.recorder.housekeeping import RETENTION_INTERVAL_S, Housekeeping
from membrane_ctrl.recorder.recorder_errors import RecorderErrors
from membrane_ctrl.run_files.detail_level import DetailLevel, decide_detail_level
from membrane_ctrl.run_files.retention import OldRun, delete_run, find_expired, list_deletable_runs

NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)


@pytest.mark.parametrize(
    ("free_mb", "level"),
    [
        (5000, DetailLevel.ALL),
        (1000, DetailLevel.ALL),
        (999, DetailLevel.NO_PICTURES),
        (100, DetailLevel.NO_PICTURES),
        (99, DetailLevel.ESSENTIAL),
        (0, DetailLevel.ESSENTIAL),
    ],
)
def test_pictures_go_first_and_numbers_last(free_mb: float, level: DetailLevel) -> None:
    assert decide_detail_level(free_mb, 500.0, DetailLevel.ALL) == level


def test_a_level_is_left_only_with_room_to_spare() -> None:
    assert decide_detail_level(1050, 500.0, DetailLevel.NO_PICTURES) == DetailLevel.NO_PICTURES
    assert decide_detail_level(1101, 500.0, DetailLevel.NO_PICTURES) == DetailLevel.ALL
    assert decide_detail_level(105, 500.0, DetailLevel.ESSENTIAL) == DetailLevel.ESSENTIAL
    assert decide_detail_level(120, 500.0, DetailLevel.ESSENTIAL) == DetailLevel.NO_PICTURES


def old_run(days: float, size_gb: float) -> OldRun:
    return OldRun(Path(f"run-{days}"), NOW - timedelta(days=days), int(size_gb * 1e9))


def gone(
    runs: list[OldRun], keep_gb: float | None, keep_days: float | None, present_gb: float = 0.0
) -> list[str]:
    return [
        run.folder.name
        for run, _ in find_expired(runs, int(present_gb * 1e9), keep_gb, keep_days, NOW)
    ]


def test_without_limits_nothing_goes() -> None:
    assert gone([old_run(9000, 1000)], None, None) == []


def test_the_oldest_go_until_the_size_fits_and_the_present_run_counts() -> None:
    runs = [old_run(9, 4), old_run(5, 4), old_run(1, 4)]
    assert gone(runs, 12.0, None) == []
    assert gone(runs, 9.0, None) == ["run-9"]
    assert gone(runs, 9.0, None, present_gb=3) == ["run-9", "run-5"]
    assert gone(runs, 0.1, None, present_gb=3) == ["run-9", "run-5", "run-1"]


def test_what_is_too_old_goes_but_never_the_newest_three() -> None:
    runs = [old_run(days, 0.1) for days in (90, 60, 31, 29, 1)]
    assert gone(runs, None, 30.0) == ["run-90", "run-60"]
    wrong_clock = [old_run(days + 20_000, 0.1) for days in (5, 4, 3, 2, 1)]
    assert gone(wrong_clock, None, 30.0) == ["run-20005", "run-20004"]


def make_run(logs: Path, name: str, summary: bool = True, touched_h_ago: float = 1.0) -> Path:
    folder = logs / name
    folder.mkdir()
    for file in ["config.toml", *(["summary.json"] if summary else [])]:
        path = folder / file
        path.write_bytes(bytes(1000))
        moment_s = (NOW - timedelta(hours=touched_h_ago)).timestamp()
        os.utime(path, (moment_s, moment_s))
    return folder


def test_only_finished_runs_that_are_not_kept_are_deleted(tmp_path: Path) -> None:
    present = make_run(tmp_path, "20261121T110000Z-now", summary=False)
    make_run(tmp_path, "20261101T110000Z-over")
    make_run(tmp_path, "20261120T110000Z-running", summary=False, touched_h_ago=2)
    make_run(tmp_path, "20261102T110000Z-crashed", summary=False, touched_h_ago=50)
    (make_run(tmp_path, "20261103T110000Z-kept") / ".keep").touch()
    make_run(tmp_path, "thesis")
    (tmp_path / "20261104T110000Z-notes").mkdir()
    (tmp_path / "notes.txt").touch()
    found = list_deletable_runs(tmp_path, present, NOW)
    assert [run.folder.name for run in found] == [
        "20261101T110000Z-over",
        "20261102T110000Z-crashed",
    ]
    assert found[0].size_bytes == 2000


def test_a_deleted_run_is_gone(tmp_path: Path) -> None:
    folder = make_run(tmp_path, "20261101T110000Z-over")
    delete_run(list_deletable_runs(tmp_path, tmp_path / "x", NOW)[0])
    assert not folder.exists()
    assert not list(tmp_path.iterdir())


class HandClock(RunClock):
    """Stands at a moment of the run."""

    def now(self) -> float:
        return 0.0


def test_the_recorder_deletes_old_runs_at_its_start_and_each_hour_and_names_them(
    tmp_path: Path,
) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    present = make_run(logs, "20261121T120000Z-now", summary=False)
    for day in range(1, 6):
        make_run(logs, f"202610{day:02d}T110000Z-old")
    reports: list[Event] = []
    config = RecordingConfig(keep_days=30.0, min_free_mb=1.0)
    keeping = Housekeeping(present, HandClock(0.0, NOW), config, RecorderErrors(reports.append))
    keeping.watch_disk(0.0, [])
    assert [report.to_dict()["run"] for report in reports] == [
        "20261001T110000Z-old",
        "20261002T110000Z-old",
    ]
    make_run(logs, "20260901T110000Z-brought")
    keeping.watch_disk(RETENTION_INTERVAL_S - 1, [])
    assert len(reports) == 2
    keeping.watch_disk(RETENTION_INTERVAL_S, [])
    assert reports[2].to_dict()["run"] == "20260901T110000Z-brought"
    assert present.exists()
    keeping.close()


def test_one_run_that_cannot_go_keeps_no_other_and_remains_of_a_crash_go_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    present = make_run(tmp_path, "20261121T120000Z-now", summary=False)
    for day in range(1, 6):
        make_run(tmp_path, f"202610{day:02d}T110000Z-old")
    make_run(tmp_path, "20261399T999999Z-no-time")
    make_run(tmp_path, ".deleted-20260901T110000Z-half")
    rename = os.rename

    def guarded(name: str, target: str, **folders: int) -> None:
        if name.startswith("20261001"):
            raise PermissionError(13, "Permission denied", name)
        rename(name, target, **folders)

    monkeypatch.setattr(os, "rename", guarded)
    reports: list[Event] = []
    config = RecordingConfig(keep_days=30.0, min_free_mb=1.0)
    keeping = Housekeeping(present, HandClock(0.0, NOW), config, RecorderErrors(reports.append))
    keeping.watch_disk(0.0, [])
    assert [report.kind for report in reports] == ["recorder_error", "run_deleted"]
    keeping.watch_disk(RETENTION_INTERVAL_S, [])
    assert len(reports) == 2, "reported once"
    monkeypatch.undo()
    (tmp_path / "20261001T110000Z-old").rename(tmp_path / "by-hand")
    keeping.watch_disk(2 * RETENTION_INTERVAL_S, [])
    assert isinstance(reports[2], RecorderRecovered)
    assert reports[2].what == "retention: 20261001T110000Z-old"
    keeping.close()
    assert isinstance(reports[0], RecorderError)
    assert "Permission denied" in reports[0].message
    assert reports[1].to_dict()["run"] == "20261002T110000Z-old"
    assert not list(tmp_path.glob(".deleted-*"))
    assert (tmp_path / "20261399T999999Z-no-time").exists()
