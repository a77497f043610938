"""The fault that outlives its run."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from firmware_iface.roles import BenchCommand
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.hold.fault_latch import FaultLatch
from membrane_ctrl.model.events import CommandTaken, Event, Fault, Resumed, StateEntered
from membrane_ctrl.model.program import file_origin, program_identity, stated_program
from membrane_ctrl.model.run_events import LatchFailed, LatchWritten
from membrane_ctrl.model.telemetry import FIELDS, TelemetryRow
from membrane_ctrl.run_files.latched_fault import (
    NAME,
    RESUMES_NAME,
    RESUMES_SCHEMA,
    LatchedFault,
    LatchedFile,
    ResumeLog,
)

FAULT = LatchedFault(
    "over_pressure", "too much", "801 Pa", "look", "2026-01-02T03:04:05+00:00", "run-1"
)
TRIP: tuple[Event, ...] = (
    Fault(40, "late", "ticks start too late", "150 ms", "50 ms", "ramp_down", True, "less work"),
    StateEntered("fault", "hold", "late"),
)


ACK = CommandTaken("ack", "unix:ann", "")


def outputs(*events: Event) -> TickOutputs:
    return TickOutputs(
        BenchCommand(0.0, 0.0), TelemetryRow(**dict.fromkeys(FIELDS, 1.0)), events, None
    )


def test_it_comes_back_as_it_was_and_goes_when_cleared(tmp_path: Path) -> None:
    file = LatchedFile(tmp_path)
    assert file.read() is None
    file.write(FAULT)
    file.sync()
    stated = json.loads(file.path.read_text())
    assert stated_program(stated) == program_identity()
    assert LatchedFile(tmp_path).read() == FAULT
    assert "801 Pa" in str(FAULT)
    file.clear()
    file.clear()
    assert file.read() is None


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"\xff\xfe",
        b"[]",
        b'"x"',
        b"null",
        b'{"schema": "other"}',
        b"\0" * 300,
        b'{"schema": "membrane-latched-fault/1"}',
        b'{"schema": "membrane-latched-fault/1", "name": 3}',
        b"[" * 30_000,
        b" " * 70_000 + b"{}",
    ],
)
def test_a_corrupt_file_counts_as_latched(tmp_path: Path, content: bytes) -> None:
    (tmp_path / NAME).write_bytes(content)
    found = LatchedFile(tmp_path).read()
    assert found is not None
    assert found.name == "unreadable"
    assert "\n" not in str(found)


def test_a_torn_file_at_every_length_counts_as_latched(tmp_path: Path) -> None:
    file = LatchedFile(tmp_path)
    file.write(FAULT)
    whole = file.path.read_bytes()
    for length in range(len(whole) - 1):
        file.path.write_bytes(whole[:length])
        assert file.read() is not None, length


def test_a_folder_or_no_permission_in_its_place_counts_as_latched(tmp_path: Path) -> None:
    (tmp_path / NAME).mkdir()
    assert LatchedFile(tmp_path).read() is not None


def test_a_link_to_nowhere_or_a_pipe_in_its_place_counts_as_latched(tmp_path: Path) -> None:
    (tmp_path / NAME).symlink_to(tmp_path / "not mounted")
    assert LatchedFile(tmp_path).read() is not None
    LatchedFile(tmp_path).clear()
    os.mkfifo(tmp_path / NAME)
    assert LatchedFile(tmp_path).read() is not None


def test_a_fault_of_many_lines_is_shown_in_one(tmp_path: Path) -> None:
    file = LatchedFile(tmp_path)
    file.write(replace(FAULT, seen="ValueError: first\nsecond"))
    assert str(file.read()).count("first second") == 1


def make(folder: Path, recorded: list[Event]) -> FaultLatch:
    return FaultLatch(
        LatchedFile(folder),
        ResumeLog(folder),
        "run-7",
        lambda mono_s: datetime(2026, 1, 1, tzinfo=UTC),
        recorded.append,
    )


def test_a_trip_is_latched_and_an_acknowledgement_clears_it(tmp_path: Path) -> None:
    events: list[Event] = []
    with make(tmp_path, events) as fault_latch:
        fault_latch.handle_tick(outputs(*TRIP))
    found = LatchedFile(tmp_path).read()
    assert found == LatchedFault(
        "late", "ticks start too late", "150 ms", "less work", "2026-01-01T00:00:00+00:00", "run-7"
    )
    with make(tmp_path, events) as fault_latch:
        fault_latch.handle_tick(outputs(replace(ACK, refused="not now")))
    assert LatchedFile(tmp_path).read() is not None
    with make(tmp_path, events) as fault_latch:
        fault_latch.handle_tick(outputs(ACK))
    assert LatchedFile(tmp_path).read() is None
    assert not events


def test_a_lock_is_no_latched_fault(tmp_path: Path) -> None:
    with make(tmp_path, []) as fault_latch:
        fault_latch.handle_tick(outputs(CommandTaken("latch", "unix:ann", "", text="hands inside")))
    assert LatchedFile(tmp_path).read() is None


def test_a_resumed_fault_is_not_latched(tmp_path: Path) -> None:
    with make(tmp_path, []) as fault_latch:
        fault_latch.handle_tick(outputs(*TRIP))
        fault_latch.handle_tick(outputs(StateEntered("standby", "fault", "resumes")))
    assert LatchedFile(tmp_path).read() is None


def test_a_forgiven_fault_is_not_latched(tmp_path: Path) -> None:
    with make(tmp_path, []) as fault_latch:
        fault_latch.handle_tick(outputs(TRIP[0]))
    assert LatchedFile(tmp_path).read() is None


def test_a_failing_disk_is_reported(tmp_path: Path) -> None:
    events: list[Event] = []
    with make(tmp_path / "nowhere", events) as fault_latch:
        fault_latch.handle_tick(outputs(*TRIP))
    assert [type(event) for event in events] == [LatchFailed]


def test_a_disk_that_works_again_is_reported_once(tmp_path: Path) -> None:
    events: list[Event] = []
    with make(tmp_path / "later", events) as fault_latch:
        fault_latch.handle_tick(outputs(*TRIP))
        while not events:
            fault_latch.handle_tick(outputs())
        (tmp_path / "later").mkdir()
        fault_latch.handle_tick(outputs(*TRIP))
        fault_latch.handle_tick(outputs(*TRIP))
    assert [type(event) for event in events] == [LatchFailed, LatchWritten]


def test_the_twin_latches_nothing(tmp_path: Path) -> None:
    with FaultLatch(
        None, None, "run", lambda mono_s: datetime(2026, 1, 1, tzinfo=UTC), lambda event: None
    ) as fault_latch:
        fault_latch.handle_tick(outputs(*TRIP))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("aim", ["mine.txt", "nowhere.txt"])
def test_a_link_in_place_of_the_reserve_takes_nothing_of_anybody(tmp_path: Path, aim: str) -> None:
    """A folder of runs may have been unpacked: the fault is latched, and what the link leads to
    stays.
    """
    (tmp_path / "mine.txt").write_text("mine")
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / f".{NAME}.reserve").symlink_to(tmp_path / aim)
    file = LatchedFile(logs)
    file.write(LatchedFault("over_pressure", "", "", "", "", ""))
    latched = file.read()
    assert latched is not None
    assert latched.name == "over_pressure"
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir() if path.is_file()] == [
        ("mine.txt", "mine")
    ]


def test_a_fault_on_a_full_disk_is_latched_in_the_room_that_was_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[Event] = []

    def full(self: LatchedFile) -> None:
        raise OSError(28, "No space left on device")

    with make(tmp_path, events) as fault_latch:
        (reserve,) = tmp_path.iterdir()
        monkeypatch.setattr(
            LatchedFile, "reserve_space", full
        )  # nothing new finds room from here on
        fault_latch.handle_tick(outputs(*TRIP))
        fault_latch._disk.submit(lambda: None).result()
        assert not reserve.exists()
    assert events == []
    latched = LatchedFile(tmp_path).read()
    assert latched is not None
    assert latched.name == "late"
    assert [path.name for path in tmp_path.iterdir()] == [NAME]


NOW = datetime(2026, 1, 2, 12, tzinfo=UTC)


def test_resumes_are_counted_for_a_day_and_beyond_a_restart(tmp_path: Path) -> None:
    assert ResumeLog(tmp_path).ages_s(NOW) == ()
    for hours in (30.0, 5.0, -1.0):  # the last one after the clock was set back
        ResumeLog(tmp_path).add_resume(NOW - timedelta(hours=hours))
    assert ResumeLog(tmp_path).ages_s(NOW) == (18_000.0, 0.0)
    stated = json.loads((tmp_path / RESUMES_NAME).read_text())
    assert (stated["schema"], stated_program(stated)) == (RESUMES_SCHEMA, program_identity())


def _with_stamps(stamps: object) -> bytes:
    return json.dumps({**file_origin(RESUMES_SCHEMA), "resumed_utc": stamps}).encode()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"\xff",
        b"3",
        b"[3]",
        b"{}",
        json.dumps({**file_origin("other/1"), "resumed_utc": []}).encode(),
        json.dumps(file_origin(RESUMES_SCHEMA)).encode(),
        _with_stamps(3),
        _with_stamps([3]),
        _with_stamps(["tomorrow"]),
        _with_stamps(["2026-01-02T11:00:00"]),  # without a zone
    ],
)
def test_a_count_of_resumes_that_cannot_be_read_is_full(tmp_path: Path, content: bytes) -> None:
    (tmp_path / RESUMES_NAME).write_bytes(content)
    assert len(ResumeLog(tmp_path).ages_s(NOW)) == 1000


def test_a_resume_of_the_run_is_counted_for_the_next_one(tmp_path: Path) -> None:
    with make(tmp_path, []) as fault_latch:
        assert fault_latch.resumes_s == ()
        fault_latch.handle_tick(outputs(Resumed("link_lost")))
    assert ResumeLog(tmp_path).ages_s(datetime(2026, 1, 1, 1, tzinfo=UTC)) == (3600.0,)
