"""A run of an earlier version stays readable; its pickled memories are skipped, never unpickled."""

from __future__ import annotations

import json
import re
import sys
import tarfile
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.events import Fault
from membrane_ctrl.run_files.inputs_file import open_inputs
from membrane_ctrl.run_files.run import open_run

RUNS = Path(__file__).parents[1] / "fixtures" / "runs"
TICKS = 702
LOST_S = 24.06  # before-safe-level: the laser


def unpacked(name: str, folder: Path) -> Path:
    with tarfile.open(RUNS / f"{name}.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder / name


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return unpacked("20261122T043916Z-earlier", tmp_path_factory.mktemp("runs"))


@pytest.fixture
def before_columns(tmp_path: Path) -> Path:
    return unpacked("20261122T151047Z-before-columns", tmp_path)


@pytest.fixture(scope="module")
def before_safe_level(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return unpacked("20261123T061500Z-before-safe-level", tmp_path_factory.mktemp("runs"))


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


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("command", [["runs", "--logs"], ["report"]])
def test_it_is_listed_and_reported(earlier: Path, command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    where = earlier.parent if command[0] == "runs" else earlier
    assert run([*command, str(where)]) == 0
    assert "earlier" in capsys.readouterr().out


def test_events_in_other_words_leave_a_run_the_same_to_the_last_bit(
    before_columns: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Since then, events have had other fields; every row and decision has stayed."""
    assert run(["replay", str(before_columns), "--json"]) == Exit.DONE
    report = json.loads(capsys.readouterr().out)
    assert (report["verdict"], report["ticks"], report["compared"], report["decisions"]) == (
        "same rows",
        1381,
        1381,
        [],
    )
    assert 0 < report["different"] < 50


def test_a_field_of_another_name_is_read_under_todays(before_safe_level: Path) -> None:
    told = open_run(before_safe_level)
    (fault,) = (each.event for each in told.log if each.event.kind == "fault")
    assert isinstance(fault, Fault)
    assert fault.safe_level == "hold_flow"
    ticks, level = told.ticks(["safe_level"]), told.overview(1.0)
    assert set(ticks.column("safe_level").to_pylist()) == {"none", "hold_flow"}
    assert "hold_flow" in level.column("safe_level").to_pylist()
    assert "rung" not in {*ticks.column_names, *level.column_names}
    assert not [note for note in told.notes if "rung" in note or "safe_level" in note]


def test_its_checksums_stay_the_same(before_safe_level: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["replay", str(before_safe_level), "--json"]) == Exit.DONE
    report = json.loads(capsys.readouterr().out)
    assert (report["verdict"], report["different"]) == ("identical", 0)
    assert report["ticks"] * 0.02 > LOST_S - report["begin_s"]


def test_rows_that_cannot_be_looked_at_are_not_called_the_same(
    before_columns: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in before_columns.glob("*.rrd"):
        path.unlink()
    assert run(["replay", str(before_columns), "--json"]) == Exit.REJECTED
    report = json.loads(capsys.readouterr().out)
    assert (report["verdict"], report["decisions"]) == ("different", [])


def test_another_pump_command_is_another_row(before_columns: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = before_columns / "config.toml"
    loop = path.read_text()
    path.write_text(re.sub(r"(?m)^kp_per_s = .*$", "kp_per_s = 0.21", loop))
    assert run(["replay", str(before_columns), "--json"]) == Exit.REJECTED
    assert json.loads(capsys.readouterr().out)["verdict"] == "different"
