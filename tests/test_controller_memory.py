"""A controller's memory: a replay that begins with it is the same to the last bit; what is none is refused."""

from __future__ import annotations

import json
import os
import pickle
import zlib
from pathlib import Path

import pytest
from virtual_record import CONFIG, kept_ticks, laser_lost, memory_at, write_record

from membrane_ctrl.cli import run
from membrane_ctrl.controller import Controller
from membrane_ctrl.controller_memory import UnknownMemoryError, recall, remember
from membrane_ctrl.errors import Exit
from membrane_ctrl.incident import check_incident, read_incident
from membrane_ctrl.metrology.hencky import zernike_projection
from membrane_ctrl.recording.inputs_file import InputsFile

TICKS = kept_ticks(20.0, laser_lost)
MIDDLE = 650  # 13 s: held, the laser is lost a second later
LATER = 850  # 17 s
MEMORY = memory_at(TICKS, MIDDLE)


def fresh() -> Controller:
    return Controller(CONFIG, zernike_projection())


def as_memory(thing: object) -> bytes:
    return zlib.compress(b"{}\n" + pickle.dumps(thing))


@pytest.mark.parametrize("tick", [2, 150, MIDDLE, 720, LATER])  # in check, inflate, hold, without a laser
def test_what_follows_is_the_same_to_the_last_bit(tick: int) -> None:
    controller = recall(memory_at(TICKS, tick), fresh())
    for inputs, outputs in TICKS[tick - 1 :]:
        again = controller.tick(inputs)
        assert again.row.pack() == outputs.row.pack()
        assert again.events == outputs.events


def test_a_memory_is_small() -> None:
    assert 1000 < len(MEMORY) < 20_000


def test_another_layout_is_refused_by_name() -> None:
    today = fresh()
    today._scene.loop._pid.wound_up = 0.0  # type: ignore[attr-defined]
    with pytest.raises(UnknownMemoryError, match=r"another layout of Pid \(wound_up\)"):
        recall(MEMORY, today)


@pytest.mark.parametrize(
    ("memory", "says"),
    [
        (b"", "cannot be read"),
        (MEMORY[:-5], "cannot be read"),
        (zlib.compress(b"[]\n"), "cannot be read"),
        (as_memory(CONFIG), "no controller's memory"),
        (as_memory(os.system), r"posix\.system"),
        (as_memory(run), r"membrane_ctrl\.cli.*run"),
        (as_memory(Path("x")), "pathlib"),
        (
            zlib.compress(b"{}\n\x80\x04\x8c\x15membrane_ctrl.systemd\x8c\x0dsocket.socket\x93."),
            "no part of a controller",
        ),
        (zlib.compress(b"{}\n" + pickle.dumps(InputsFile)), "InputsFile, which is no part"),
    ],
)
def test_what_is_no_memory_is_refused(memory: bytes, says: str) -> None:
    with pytest.raises(UnknownMemoryError, match=says):
        recall(memory, fresh())


def test_what_cannot_be_written_down_is_no_memory() -> None:
    controller = fresh()
    controller._scene.asked_by = lambda: None  # type: ignore[assignment]
    assert remember(controller) == b""


@pytest.fixture
def record(tmp_path: Path) -> Path:
    folder = tmp_path / "20261121T010203Z-night"
    folder.mkdir()
    write_record(folder, TICKS, memories={MIDDLE: MEMORY, LATER: memory_at(TICKS, LATER)})
    return folder


@pytest.mark.parametrize(("start", "first"), [("13.2s", MIDDLE), ("16.9s", MIDDLE), ("18s", LATER), ("5s", 1)])
def test_a_replay_begins_with_the_last_memory_before(
    record: Path, start: str, first: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["replay", str(record), "--from", start, "--json"]) == Exit.DONE
    report = json.loads(capsys.readouterr().out)
    assert report["verdict"] == "identical"
    assert report["ticks"] == len(TICKS) - first + 1
    assert report["begin_s"] == TICKS[first - 1][0].now_s
    assert report["from_memory"] == (first > 1)


@pytest.mark.parametrize(
    ("window", "says"),
    [
        (("--from", "99h"), "the record ends at 20.0 s"),
        (("--from", "9s", "--to", "8s"), "--from 9s is not before --to 8s"),
    ],
)
def test_a_part_that_the_run_has_not_is_one_line(
    record: Path, window: tuple[str, ...], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["replay", str(record), *window]) == Exit.BAD_INPUT
    assert says in capsys.readouterr().err


def test_a_memory_of_another_layout_is_told_and_the_replay_begins_with_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_record(tmp_path, TICKS, memories={MIDDLE: as_memory(CONFIG)})
    assert run(["replay", str(tmp_path), "--from", "14s"]) == Exit.DONE
    printed = capsys.readouterr()
    assert "from the run's start" in printed.err
    assert "begins" not in printed.out


def test_an_incident_begins_in_the_middle(record: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tests" / "incidents").mkdir(parents=True)
    window = ("--from", "13.5s", "--to", "16s")
    assert run(["replay", str(record), *window, "--to-test", "laser-lost"]) == Exit.DONE
    incident = read_incident(tmp_path / "tests" / "incidents" / "laser-lost")
    assert [decision.what for decision in incident.expected if "shape" not in decision.what] == [
        "state hold",
        "fault displacement_missing",
        "cleared displacement_missing",
    ]
    assert incident.expected[0].time_s > 13.0
    assert check_incident(incident) == []
    monkeypatch.setattr("membrane_ctrl.incident.replay", _refuse)
    assert "make the incident again" in check_incident(incident)[0]


def _refuse(*_: object) -> None:
    raise UnknownMemoryError("another layout")


@pytest.mark.parametrize("layout", ["today's", "another"])
def test_behind_a_gap_the_next_memory_is_taken_up_and_compared_from_there(
    tmp_path: Path, layout: str, capsys: pytest.CaptureFixture[str]
) -> None:
    memory = MEMORY if layout == "today's" else as_memory(CONFIG)
    write_record(tmp_path, TICKS, range(510, 521), memories={MIDDLE: memory})
    assert run(["replay", str(tmp_path), "--json"]) == Exit.REJECTED
    report = json.loads(capsys.readouterr().out)
    assert (report["verdict"], report["different"]) == ("gaps", 0)
    assert report["compared"] == 509 + (len(TICKS) - MIDDLE + 1 if layout == "today's" else 0)


def test_no_incident_is_made_across_a_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tests" / "incidents").mkdir(parents=True)
    write_record(tmp_path, TICKS, range(510, 521), memories={MIDDLE: MEMORY})
    assert run(["replay", str(tmp_path), "--to-test", "torn"]) == Exit.BAD_INPUT
    assert "ticks are missing at 10.2 s" in capsys.readouterr().err
    assert run(["replay", str(tmp_path), "--from", "13.5s", "--to-test", "whole"]) == Exit.DONE
    assert [path.name for path in (tmp_path / "tests" / "incidents").iterdir()] == ["whole"]


@pytest.mark.parametrize("left", [b"", b"noise" * 100])
def test_inputs_of_which_nothing_can_be_read_are_said_to_be_so(
    record: Path, left: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    (record / "inputs-000.bin").write_bytes(left)
    assert run(["replay", str(record)]) == Exit.BAD_INPUT
    said = capsys.readouterr().err
    assert "no tick to replay" in said
    assert "inputs-000.bin" in said
    assert said.count("\n") == 1
