"""A controller's memory: a replay that begins with it is identical to the last bit; anything else is refused."""

from __future__ import annotations

import json
import pickle
import random
import zlib
from collections import Counter, deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.memory import UnknownMemoryError, recall, remember
from membrane_ctrl.metrology.optics.film_law import zernike_projection
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.replay.replay import RecordedTick, replay
from tests.support.incidents import check_incident, read_incident
from tests.support.virtual_record import CONFIG, kept_ticks, laser_lost, memory_at, write_record

TICKS = kept_ticks(20.0, laser_lost)
MIDDLE = 650  # 13 s: held, the laser is lost a second later
LATER = 850  # 17 s
MEMORY = memory_at(TICKS, MIDDLE)


def fresh() -> Controller:
    return Controller(CONFIG, zernike_projection())


def plain() -> Any:
    return json.loads(zlib.decompress(MEMORY))


def as_memory(data: object) -> bytes:
    return zlib.compress(json.dumps(data).encode())


def with_value(path: str, value: object) -> bytes:
    """The memory, with another value at a path of attributes."""
    data = place = plain()
    *way, last = path.split(".")
    for name in way:
        place = place[name]
    assert last in place
    place[last] = value
    return as_memory(data)


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


def test_a_memory_with_a_field_of_another_name_is_todays() -> None:
    former = json.dumps(plain(), separators=(",", ":")).replace('"safe_level":', '"rung":')
    assert '"rung":' in former
    assert remember(recall(zlib.compress(former.encode()), fresh())) == MEMORY


@pytest.mark.parametrize(
    "memory",
    [
        b"",
        MEMORY[:-5],
        MEMORY[1:],
        zlib.compress(b"[]"),
        zlib.compress(b"{"),
        zlib.compress(b"[" * 500_000),
        zlib.compress(b" " * 200_000_000),
        zlib.compress(b"{}\n" + pickle.dumps(CONFIG)),
        zlib.compress(b"{}\n\x80\x04\x8c\x02os\x8c\x06system\x93."),
        as_memory({"": "Controller"}),
        as_memory({"": "Popen", "args": "true"}),
    ],
    ids=range(11),
)
def test_what_is_no_memory_is_refused(memory: bytes) -> None:
    with pytest.raises(UnknownMemoryError, match=r"^the recorded memory cannot be used: .+$"):
        recall(memory, fresh())


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("_ticks", "650"),
        ("_ticks", 650.0),
        ("_ticks", True),
        ("_ticks", 2**63),
        ("_ticks", None),
        ("_scene.paused", 1),
        ("_tick_error", None),
        ("_why_since_s", "nan"),
        ("_why_since_s", [0.0]),
        ("state", "hold"),
        ("state", 99),
        ("fault", -1),
        ("fault", [1]),
        ("_config", "limits"),
        ("_config", "__class__"),
        ("_config", {"loop": {"rate_hz": "fast"}}),
        ("_scene.loop_config", {"kp_per_s": -1e9}),
        ("_scene.config", None),
        ("_scene.way_down", "sideways"),
        ("_scene.trial", {"": "Trial", "spec": {}}),
        ("_scene.test", {"": "ActuatorTest"}),
        ("_scene.output", {"": "LoopOutput", "setpoint_um": 0.0}),
        ("_scene.loop", {"": "Controller"}),
        ("_scene.observer._stamp", [1]),
        ("_scene.observer._stamp", [1, 2.0, 3]),
        ("_scene.levels._limit_s", {"HOLD_FLOW": 1.0}),
        ("_scene.levels._limit_s", [[1, 2, 3]]),
        ("_scene.levels._limit_s", [5]),
        ("_safety._history", "0000"),
        ("_safety._table", [10**6]),
        ("_resume._resumed_s", {"maxlen": -1, "items": []}),
        ("_resume._resumed_s", {"maxlen": 2**62, "items": []}),
        ("_resume._resumed_s", []),
        ("_shape._sensitivity", {"dtype": "<f8", "shape": [2**40], "data": ""}),
        ("_shape._sensitivity", {"dtype": "<f8", "shape": [-1], "data": ""}),
        ("_shape._sensitivity", {"dtype": "|O", "shape": [1], "data": "AAAAAAAAAAA="}),
        ("_shape._sensitivity", {"dtype": "<f8", "shape": [1], "data": "not base64"}),
        ("_shape._sensitivity", {"dtype": ["<f8"], "shape": [1], "data": "AAAAAAAAAAA="}),
        ("_shape._reference._taken", ["gASVAAAAAAAAAAAu"]),
        ("_shape._reference._taken", [7]),
    ],
)
def test_every_value_is_checked_against_its_type(path: str, value: object) -> None:
    with pytest.raises(UnknownMemoryError, match=r"^the recorded memory cannot be used: .+$"):
        recall(with_value(path, value), fresh())


def test_the_limits_are_those_of_the_run_and_not_of_its_memory() -> None:
    assert b"gauge_pressure_max_pa" not in zlib.decompress(MEMORY)
    limits = {**CONFIG.limits.model_dump(), "gauge_pressure_max_pa": 1e9}
    with pytest.raises(UnknownMemoryError):
        recall(with_value("_safety._limits", {**limits, "stale_s": "x"}), fresh())


def test_random_damage_is_refused_or_replayed_without_a_traceback() -> None:
    """A forged memory of right types may hold any values; then the first tick that raises refuses it."""
    random_of = random.Random(15)
    text = zlib.decompress(MEMORY)
    ticks = [RecordedTick(MIDDLE + k, inputs, 0) for k, (inputs, _) in enumerate(TICKS[MIDDLE - 1 : MIDDLE + 20])]
    outcomes = Counter[str]()
    for _ in range(1500):
        data = bytearray(text)
        for _ in range(random_of.randint(1, 2)):
            place = random_of.randrange(len(data))
            data[place : place + random_of.randint(0, 3)] = random_of.choice(_SCRAPS)
        begun = replace(ticks[0], memory=zlib.compress(bytes(data), 1))
        try:
            replay(CONFIG, [begun, *ticks[1:]], zernike_projection())
        except UnknownMemoryError:
            outcomes["refused"] += 1
        else:
            outcomes["replayed"] += 1
    assert outcomes["refused"] > 500
    assert outcomes["replayed"] > 20


_SCRAPS = (
    b"",
    b"0",
    b"9",
    b"-",
    b"1e308",
    b"NaN",
    b"Infinity",
    b"null",
    b"true",
    b'"',
    b"[",
    b"]",
    b"{}",
    b",",
    b"a",
)


def test_a_tick_that_raises_after_a_forged_memory_is_the_memorys_fault() -> None:
    memory = with_value("_safety._history", [0])  # a valid one has as many as there are rules
    inputs, outputs = TICKS[MIDDLE - 1]
    with pytest.raises(UnknownMemoryError, match="cannot be used: IndexError at 13"):
        replay(CONFIG, [RecordedTick(MIDDLE, inputs, 0, memory)], zernike_projection())
    assert outputs.finished is None


def test_numbers_words_and_containers_come_back_as_they_were() -> None:
    again = recall(MEMORY, fresh())
    assert remember(again) == MEMORY
    assert type(again.state) is State
    assert isinstance(again._resume._resumed_s, deque)
    assert again._scene.config is again._config


def test_a_memory_that_inflates_is_not_taken_in() -> None:
    with pytest.raises(UnknownMemoryError, match="too long"):
        recall(zlib.compress(b"1" + b" " * 50_000_000), fresh())


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
        (("--from", "99h"), "the record ends at 22.5 s"),
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
    write_record(tmp_path, TICKS, memories={MIDDLE: as_memory({})})
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
    monkeypatch.setattr("tests.support.incidents.replay", _refuse)
    assert "make the incident again" in check_incident(incident)[0]


def _refuse(*_: object) -> None:
    raise UnknownMemoryError("another layout")


@pytest.mark.parametrize("layout", ["today's", "another"])
def test_behind_a_gap_the_next_memory_is_taken_up_and_compared_from_there(
    tmp_path: Path, layout: str, capsys: pytest.CaptureFixture[str]
) -> None:
    memory = MEMORY if layout == "today's" else as_memory({})
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
    (record / "columns" / "ticks-000.arrows").write_bytes(left)
    assert run(["replay", str(record)]) == Exit.BAD_INPUT
    said = capsys.readouterr().err
    assert "no tick to replay" in said
    assert "ticks-000.arrows" in said
    assert said.count("\n") == 1
