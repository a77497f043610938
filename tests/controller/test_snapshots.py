"""Snapshots of the controller: a replay from one is identical to the last bit; other data is
refused.
"""

from __future__ import annotations

import json
import pickle
import random
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.snapshot import (
    UnknownSnapshotError,
    continue_from,
    decode_snapshot,
    take_snapshot,
)
from membrane_ctrl.controller.tick_codec import SNAPSHOT_BYTES_MAX
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.state_tree import find_differences
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.replay.replay import RecordedTick, replay_record
from tests.support.incidents import check_incident, read_incident
from tests.worlds.controller_runs import STORIES, record_story
from tests.worlds.virtual_record import CONFIG, kept_ticks, laser_lost, snapshot_at, write_record

TICKS = kept_ticks(20.0, laser_lost)
MIDDLE = 650  # 13 s: held, the laser is lost a second later
LATER = 850  # 17 s
SNAPSHOT = snapshot_at(TICKS, MIDDLE)


def fresh() -> Controller:
    return Controller(CONFIG, zernike_projection())


def resume(snapshot: bytes, config: Config = CONFIG) -> Controller:
    return continue_from(snapshot, config, zernike_projection())


def plain() -> Any:
    return json.loads(SNAPSHOT)


def as_snapshot(data: object) -> bytes:
    return json.dumps(data, separators=(",", ":"), ensure_ascii=False).encode()


def with_value(path: str, value: object) -> bytes:
    """The snapshot, with another value at a path of fields."""
    data = place = plain()
    *way, last = path.split(".")
    for name in way:
        place = place[name]
    assert last in place
    place[last] = value
    return as_snapshot(data)


@pytest.mark.parametrize(
    "tick", [2, 150, MIDDLE, 720, LATER]
)  # in check, inflate, hold, without a laser
def test_a_controller_from_a_snapshot_continues_bit_by_bit(tick: int) -> None:
    controller = resume(snapshot_at(TICKS, tick))
    for inputs, outputs in TICKS[tick - 1 :]:
        again = controller.tick(inputs)
        assert again.row.pack() == outputs.row.pack()
        assert again.events == outputs.events


@pytest.mark.parametrize("name", STORIES)
def test_a_replay_goes_from_snapshot_to_snapshot_with_the_same_bits(name: str) -> None:
    """In every state, with every sensor lost, on trial and in all experiments: nothing is
    remembered elsewhere.
    """
    story = STORIES[name]
    ticks, last = record_story(story)
    controller = Controller(story.config, zernike_projection())
    for number, (inputs, outputs) in enumerate(ticks):
        if number % 37 == 36:
            controller = resume(take_snapshot(controller), story.config)
        again = controller.tick(inputs)
        assert again.row.pack() == outputs.row.pack(), number
        assert (again.command, again.events, again.answers) == (
            outputs.command,
            outputs.events,
            outputs.answers,
        )
    assert find_differences(controller.memory, last) == []


def test_two_controllers_are_compared_field_by_field() -> None:
    one, other = resume(SNAPSHOT), resume(SNAPSHOT)
    assert find_differences(one.memory, other.memory) == []
    other.memory.loop.integrator.error_um += 1.0
    other.memory.context.asked_by = "ann"
    found = find_differences(one.memory, other.memory)
    assert [each.split(":")[0] for each in found] == [
        "context.asked_by",
        "loop.integrator.error_um",
    ]


def test_a_snapshot_is_small_and_needs_no_other_file() -> None:
    assert 5_000 < len(SNAPSHOT) < 15_000
    assert decode_snapshot(SNAPSHOT).state == State.SETTLE


def test_another_layout_is_refused_by_name() -> None:
    data = plain()
    del data["loop"]["integrator"]["error_um"]
    with pytest.raises(
        UnknownSnapshotError, match=r"another layout: loop\.integrator\.error_um is missing"
    ):
        resume(as_snapshot(data))
    data = plain()
    data["loop"]["integrator"]["wound_up"] = 0.0
    with pytest.raises(UnknownSnapshotError, match=r"loop\.integrator\.wound_up: Unexpected"):
        resume(as_snapshot(data))


@pytest.mark.parametrize(
    "snapshot",
    [
        b"",
        SNAPSHOT[:-5],
        SNAPSHOT[1:],
        b"[]",
        b"{",
        b"[" * 200_000,
        b" " * (SNAPSHOT_BYTES_MAX + 1),
        pickle.dumps(CONFIG),
        b"\x80\x04\x8c\x02os\x8c\x06system\x93.",
        as_snapshot({"gains": {}}),
        SNAPSHOT + b"]",
    ],
    ids=range(11),
)
def test_damaged_or_foreign_data_is_refused_as_snapshot(snapshot: bytes) -> None:
    with pytest.raises(UnknownSnapshotError, match=r"^the snapshot cannot be used: .+$"):
        resume(snapshot)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("ticks", "650"),
        ("ticks", 650.0),
        ("ticks", True),
        ("ticks", -1),
        ("ticks", 2**63),
        ("ticks", None),
        ("context.paused", 1),
        ("tick_error", None),
        ("why_since_s", "nan"),
        ("why_since_s", [0.0]),
        ("state", "hold"),
        ("state", 99),
        ("fault", -1),
        ("fault", 2**60),
        ("fault", [1]),
        ("gains.good.loop", "loop"),
        ("gains.tried.loop", {"rate_hz": "fast"}),
        ("gains.tried.loop.kp_per_s", -1e9),
        ("context.way_down", "sideways"),
        ("context.trial_memory", {"spec": {}}),
        ("context.test_memory", {"pump": {}}),
        ("context.output", {"setpoint_um": 0.0}),
        ("observer.stamp", [1]),
        ("observer.stamp", [1, 2.0, 3]),
        ("safety.history", {"over_pressure": 1}),
        ("safety.history", [0]),
        ("resume.resumed_s", {}),
        ("shape.reference.coeffs_um", "AAAAAAAAAAA="),
        ("shape.reference.coeffs_um", "not base64"),
        ("shape.reference.coeffs_um", [0.0]),
        ("loop.drift.spread", ""),
        ("estimation.centre", {"x": ""}),
    ],
)
def test_every_value_is_checked_against_its_type(path: str, value: object) -> None:
    with pytest.raises(UnknownSnapshotError, match=r"^the snapshot cannot be used: .+$"):
        resume(with_value(path, value))


@pytest.mark.parametrize(
    ("path", "value"),
    [("fault", 9999), ("gains.tried.loop.rate_hz", 200.0), ("gains.good.loop.rate_hz", 200.0)],
)
def test_a_snapshot_that_does_not_fit_the_configuration_is_refused(
    path: str, value: object
) -> None:
    with pytest.raises(UnknownSnapshotError, match="does not fit the configuration"):
        resume(with_value(path, value))


def test_the_limits_are_those_of_the_run_and_not_of_its_snapshot() -> None:
    assert b"gauge_pressure_max_pa" not in SNAPSHOT


def test_random_damage_is_refused_or_replayed_without_a_traceback() -> None:
    """A forged snapshot of right types may hold any values; then the first tick that raises refuses
    it.
    """
    random_of = random.Random(15)
    ticks = [
        RecordedTick(MIDDLE + k, inputs, 0)
        for k, (inputs, _) in enumerate(TICKS[MIDDLE - 1 : MIDDLE + 20])
    ]
    outcomes = Counter[str]()
    for _ in range(1500):
        data = bytearray(SNAPSHOT)
        for _ in range(random_of.randint(1, 2)):
            place = random_of.randrange(len(data))
            data[place : place + random_of.randint(0, 3)] = random_of.choice(_SCRAPS)
        begun = replace(ticks[0], snapshot=bytes(data))
        try:
            replay_record(CONFIG, [begun, *ticks[1:]], zernike_projection())
        except UnknownSnapshotError:
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


def test_a_tick_that_raises_after_a_forged_snapshot_is_the_snapshots_fault() -> None:
    inputs, _ = TICKS[MIDDLE - 1]
    controller = resume(SNAPSHOT)
    consistency = controller.memory.consistency
    consistency.camera_s = inputs.now_s
    consistency.plausibility.age_s, consistency.plausibility.readings = 100.0, 1000
    consistency.plausibility.optics.value = 37_000.0
    consistency.plausibility.fast.begin(
        (0.0, 37_000.0, 0.0)
    )  # no gauge pressure, by which it divides
    forged = take_snapshot(controller)
    with pytest.raises(UnknownSnapshotError, match="cannot be used: ZeroDivisionError at 13"):
        replay_record(CONFIG, [RecordedTick(MIDDLE, inputs, 0, forged)], zernike_projection())


def test_numbers_words_and_containers_come_back_as_they_were() -> None:
    again = resume(SNAPSHOT)
    assert take_snapshot(again) == SNAPSHOT
    assert type(again.state) is State


def test_a_value_of_a_wrong_type_in_the_memory_is_an_error_of_the_program() -> None:
    controller = fresh()
    controller.memory.context.asked_by = lambda: None  # type: ignore[assignment]
    with pytest.raises(ValueError, match="serialize"):
        take_snapshot(controller)


@pytest.fixture
def record(tmp_path: Path) -> Path:
    folder = tmp_path / "20261121T010203Z-night"
    folder.mkdir()
    write_record(folder, TICKS, snapshots={MIDDLE: SNAPSHOT, LATER: snapshot_at(TICKS, LATER)})
    return folder


@pytest.mark.parametrize(
    ("start", "first"), [("13.2s", MIDDLE), ("16.9s", MIDDLE), ("18s", LATER), ("5s", 1)]
)
def test_a_replay_begins_with_the_last_snapshot_before(
    record: Path, start: str, first: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["replay", str(record), "--from", start, "--json"]) == Exit.DONE
    report = json.loads(capsys.readouterr().out)
    assert report["verdict"] == "identical"
    assert report["ticks"] == len(TICKS) - first + 1
    assert report["begin_s"] == TICKS[first - 1][0].now_s
    assert report["from_snapshot"] == (first > 1)


@pytest.mark.parametrize(
    ("window", "message"),
    [
        (("--from", "99h"), "the record ends at 22.5 s"),
        (("--from", "9s", "--to", "8s"), "--from 9s is not before --to 8s"),
    ],
)
def test_a_part_outside_the_run_is_a_one_line_error(
    record: Path, window: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["replay", str(record), *window]) == Exit.BAD_INPUT
    assert message in capsys.readouterr().err


def test_a_snapshot_of_another_layout_is_reported_and_the_replay_begins_with_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_record(tmp_path, TICKS, snapshots={MIDDLE: as_snapshot({})})
    assert run(["replay", str(tmp_path), "--from", "14s"]) == Exit.DONE
    printed = capsys.readouterr()
    assert "from the run's start" in printed.err
    assert "begins" not in printed.out


def test_an_incident_begins_in_the_middle(
    record: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tests" / "incidents").mkdir(parents=True)
    window = ("--from", "13.5s", "--to", "16s")
    assert run(["replay", str(record), *window, "--to-test", "laser-lost"]) == Exit.DONE
    incident = read_incident(tmp_path / "tests" / "incidents" / "laser-lost")
    assert [
        decision.description
        for decision in incident.expected
        if "shape" not in decision.description
    ] == [
        "state hold",
        "fault displacement_missing",
        "cleared displacement_missing",
    ]
    assert incident.expected[0].time_s > 13.0
    assert check_incident(incident) == []
    monkeypatch.setattr("tests.support.incidents.replay_record", _refuse)
    assert "make the incident again" in check_incident(incident)[0]


def _refuse(*_: object) -> None:
    raise UnknownSnapshotError("another layout")


@pytest.mark.parametrize("layout", ["today's", "another"])
def test_after_a_gap_the_replay_continues_from_the_next_snapshot(
    tmp_path: Path, layout: str, capsys: pytest.CaptureFixture[str]
) -> None:
    snapshot = SNAPSHOT if layout == "today's" else as_snapshot({})
    write_record(tmp_path, TICKS, range(510, 521), snapshots={MIDDLE: snapshot})
    assert run(["replay", str(tmp_path), "--json"]) == Exit.REJECTED
    report = json.loads(capsys.readouterr().out)
    assert (report["verdict"], report["different"]) == ("gaps", 0)
    assert report["compared"] == 509 + (len(TICKS) - MIDDLE + 1 if layout == "today's" else 0)


def test_no_incident_is_made_across_a_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tests" / "incidents").mkdir(parents=True)
    write_record(tmp_path, TICKS, range(510, 521), snapshots={MIDDLE: SNAPSHOT})
    assert run(["replay", str(tmp_path), "--to-test", "torn"]) == Exit.BAD_INPUT
    assert "ticks are missing at 10.2 s" in capsys.readouterr().err
    assert run(["replay", str(tmp_path), "--from", "13.5s", "--to-test", "whole"]) == Exit.DONE
    assert [path.name for path in (tmp_path / "tests" / "incidents").iterdir()] == ["whole"]


@pytest.mark.parametrize("left", [b"", b"noise" * 100])
def test_unreadable_inputs_are_reported(
    record: Path, left: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    (record / "inputs" / "inputs-0000.parquet").write_bytes(left)
    assert run(["replay", str(record)]) == Exit.BAD_INPUT
    output = capsys.readouterr().err
    assert "no tick to replay" in output
    assert "inputs-0000.parquet" in output
    assert output.count("\n") == 1


def test_the_state_at_the_end_of_a_part_is_printed(
    record: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["replay", str(record), "--from", "13.2s", "--to", "14s", "--state"]) == Exit.DONE
    lines = capsys.readouterr().out.splitlines()
    assert "state      after the tick at 14.000 s:" in lines
    assert [line.split() for line in lines if line.startswith("ticks ")] == [["ticks", "700"]]
    assert [
        line.split()[1] for line in lines if line.startswith("state ") and "after" not in line
    ] == ["SETTLE"]
    assert run(["replay", str(record), "--to", "14s", "--state", "--json"]) == Exit.DONE
    report = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert (report["state"]["ticks"], report["state"]["state"]) == (700, "SETTLE")
    assert report["state"]["gains"]["until_s"] is None  # JSON has no NaN


def test_a_replayed_state_is_compared_with_each_snapshot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = json.loads(snapshot_at(TICKS, LATER))
    other["loop"]["curve"]["kick_left_s"] = 1.0
    write_record(tmp_path, TICKS, snapshots={MIDDLE: SNAPSHOT, LATER: as_snapshot(other)})
    assert run(["replay", str(tmp_path), "--json"]) == Exit.DONE
    differs = json.loads(capsys.readouterr().out)["state_differences"]
    assert differs["time_s"] == TICKS[LATER - 1][0].now_s
    (field,) = differs["fields"]
    assert field.startswith("loop.curve.kick_left_s: 1.0, ")
    assert run(["replay", str(tmp_path)]) == Exit.DONE
    assert "state      differs from the snapshot at 17.00 s in 1 fields:" in capsys.readouterr().out
