"""A run recorded by an earlier version stays readable; its pickled memories are passed over, never unpickled."""

from __future__ import annotations

import json
import sys
import tarfile
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.run_files.inputs_file import open_inputs

ARCHIVE = Path(__file__).parents[1] / "fixtures" / "runs" / "20261122T043916Z-earlier.tar.xz"
TICKS = 702


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
    return folder / ARCHIVE.name.removesuffix(".tar.xz")


def test_every_tick_shape_and_memory_of_it_is_read(earlier: Path) -> None:
    reader = open_inputs(earlier)
    frames = list(reader)
    assert reader.damage == []
    assert sum(len(frame.records) for frame in frames) == TICKS
    assert sum(len(frame.estimates) for frame in frames) == 5
    assert sum(len(frame.memories) for frame in frames) == 3


def test_its_replay_begins_with_the_run(
    earlier: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pickle", None)  # an import of it fails
    run(["replay", str(earlier), "--from", "10s", "--json"])
    printed = capsys.readouterr()
    assert "from the run's start: the recorded memory cannot be used" in printed.err
    report = json.loads(printed.out)
    assert (report["from_memory"], report["damage"]) == (False, [])
    assert abs(report["ticks"] - TICKS) < 50  # today's code may be through a little earlier


@pytest.mark.parametrize("command", [["runs", "--logs"], ["report"]])
def test_it_is_listed_and_reported(earlier: Path, command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    where = earlier.parent if command[0] == "runs" else earlier
    assert run([*command, str(where)]) == 0
    assert "earlier" in capsys.readouterr().out
