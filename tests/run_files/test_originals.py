"""No review command harms the recorder's files, and marks are as given."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from membrane_ctrl.cli import run as command
from membrane_ctrl.review.export import export_run
from membrane_ctrl.run_files.annotations import ANNOTATIONS_FILE
from membrane_ctrl.run_files.run import open_run
from tests.support.review_runs import written

Capsys = pytest.CaptureFixture[str]


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("inside", [".", "ticks", "ticks/../."])
def test_nothing_is_exported_over_a_run(tmp_path: Path, capsys: Capsys, inside: str) -> None:
    folder, other = written(tmp_path / "a", 0.01), written(tmp_path / "b", 0.01)
    before = contents(tmp_path)
    for target in (folder / inside, other / inside):
        assert (
            command(
                [
                    "export",
                    str(folder),
                    "--format",
                    "csv",
                    "--streams",
                    "events",
                    "--out",
                    str(target),
                ]
            )
            == 2
        )
        assert "choose another folder" in capsys.readouterr().err
    assert contents(tmp_path) == before


@pytest.mark.parametrize("to", ["csv", "hdf5"])
def test_an_export_that_fails_leaves_the_one_before(tmp_path: Path, to: str) -> None:
    folder, out = written(tmp_path, 0.01), tmp_path / "out"
    export_run(open_run(folder), to, out)
    before = contents(out)
    assert command(["export", str(folder), "--format", to, "--out", str(out), "--from", "+9h"]) == 2
    assert contents(out) == before
    assert not list(out.glob(".*"))


@pytest.mark.parametrize(("at", "text"), [("+9h", "beyond"), ("-5s", "before"), ("+10s", " ")])
def test_a_mark_outside_the_run_or_without_words_is_refused(
    tmp_path: Path, at: str, text: str
) -> None:
    folder = written(tmp_path, 0.01)
    assert command(["review", "mark", str(folder), text, f"--at={at}"]) == 2
    assert not (folder / ANNOTATIONS_FILE).exists()


def test_a_mark_is_kept_to_the_letter(tmp_path: Path) -> None:
    folder, text = written(tmp_path, 0.01), "see http://lab/log//7 and ./x/"
    assert command(["review", "mark", str(folder), text, "--at", "+10s"]) == 0
    assert [event["text"] for event in open_run(folder).events if event["kind"] == "mark"] == [text]


def test_a_link_to_a_run_is_not_pruned(tmp_path: Path, capsys: Capsys) -> None:
    elsewhere, logs = written(tmp_path / "elsewhere", 0.01), tmp_path / "logs"
    (elsewhere / "summary.json").write_text("{}")
    logs.mkdir()
    (logs / elsewhere.name).symlink_to(elsewhere)
    before = contents(elsewhere)
    assert command(["runs", "prune", "--logs", str(logs), "--keep-gb", "0", "--delete"]) == 0
    assert "0 runs" in capsys.readouterr().out
    assert contents(elsewhere) == before
    assert [path.name for path in logs.iterdir()] == [elsewhere.name]


def test_a_run_that_cannot_be_deleted_keeps_no_other(
    tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = written(tmp_path, 0.01), written(tmp_path, 0.01, name="20261122T180000Z-later")
    for folder in (first, second):
        (folder / "summary.json").write_text("{}")
    rename = os.rename

    def refused(source: str, target: str, **folders: int) -> None:
        if source == first.name:
            raise PermissionError(13, "Permission denied")
        rename(source, target, **folders)

    monkeypatch.setattr("membrane_ctrl.run_files.retention.os.rename", refused)
    assert command(["runs", "prune", "--logs", str(tmp_path), "--keep-gb", "0", "--delete"]) == 4
    output = capsys.readouterr()
    assert f"{first}: cannot be deleted" in output.err
    assert f"deleted {second.name}" in output.out
    assert first.exists()
    assert not second.exists()
