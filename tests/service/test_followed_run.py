"""The service sends the alarms of a run from its rings and files, also after the run's end."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType

import pytest

from membrane_ctrl.alarms.sent_log import LOG_NAME, SentLog
from membrane_ctrl.model.telemetry import FIELDS, ROW_BYTES, TelemetryRow
from membrane_ctrl.processes.published_rings import publish_rings
from membrane_ctrl.processes.ring import RingAddress, RingWriter, open_ring
from membrane_ctrl.service.alarm_process import FolderAlarms, is_working
from membrane_ctrl.service.ended_run import find_newest_run
from membrane_ctrl.service.runs_to_follow import read_alarms_config

DAY_S = 86_400.0
ROW = TelemetryRow(*(0.0 for _ in FIELDS))


class Target:
    """A service that Apprise makes of an URL."""

    sent: list[str] = []  # noqa: RUF012  one list for all, as the test reads it

    def notify(self, title: str, body: str, notify_type: str) -> bool:
        self.sent.append(title.rpartition(": ")[2])
        return True


@pytest.fixture
def phone(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    class Apprise:
        @staticmethod
        def instantiate(url: str) -> Target:
            return Target()

    module = ModuleType("apprise")
    module.Apprise = Apprise  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "apprise", module)
    Target.sent.clear()
    yield Target.sent
    Target.sent.clear()


class Run:
    """A run that a control process has published."""

    def __init__(self, logs: Path, stack: ExitStack, alarms: bool = True, name: str = "a") -> None:
        self.folder = logs / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{name}"
        self.folder.mkdir(parents=True)
        urls = logs / "urls.txt"
        urls.write_text("mail://anna\n")
        text = f'[alarms]\nurls_file = "{urls}"\n' if alarms else ""
        (self.folder / "config.toml").write_text(text)
        self._events = self._open_ring(stack, 4096)
        self._telemetry = self._open_ring(stack, ROW_BYTES)
        self.process = stack.enter_context(ExitStack())
        rings = {"events": self._events, "telemetry": self._telemetry}
        publish_rings(self.folder, rings, self.process)
        self.events = RingWriter(self._events)
        self.telemetry = RingWriter(self._telemetry)
        stack.callback(self.events.close)
        stack.callback(self.telemetry.close)

    @staticmethod
    def _open_ring(stack: ExitStack, slot_bytes: int) -> RingAddress:
        return stack.enter_context(open_ring(64, slot_bytes))

    def emit(self, in_file: bool = False, **fields: object) -> None:
        """Put an event into the ring; `in_file`: the recorder has written it as well."""
        line = json.dumps(fields)
        self.events.put(line.encode())
        if in_file:
            self.record(line)

    def record(self, line: str) -> None:
        with (self.folder / "events.jsonl").open("a") as file:
            file.write(line + "\n")


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as found:
        yield found


def follow(logs: Path, stack: ExitStack) -> FolderAlarms:
    found = FolderAlarms(logs)
    found._find_at_s = -1.0
    stack.callback(found.close)
    return found


def find_again(folder: FolderAlarms) -> None:
    folder._find_at_s = -1.0
    folder.step()


FAULT = {"kind": "fault", "name": "late", "latching": True, "mono_s": 5.0}


def test_a_fault_is_sent_once_though_it_is_in_ring_and_file(
    tmp_path: Path, stack: ExitStack, phone: list[str]
) -> None:
    run = Run(tmp_path, stack)
    run.emit(in_file=True, **FAULT)
    service = follow(tmp_path, stack)
    for _ in range(3):
        service.step()
    assert phone == ["fault"]
    run.emit(**(FAULT | {"mono_s": 9.0, "name": "over_pressure"}))
    run.emit(kind="lock", word="bofak", mono_s=9.0)
    service.step()
    assert phone == ["fault", "lock"]


def test_events_that_the_ring_has_lost_are_read_from_the_file(
    tmp_path: Path, stack: ExitStack, phone: list[str]
) -> None:
    run = Run(tmp_path, stack)
    run.record(json.dumps(FAULT))
    service = follow(tmp_path, stack)
    service.step()
    assert phone == ["fault"]


def test_a_hold_that_vanishes_is_reported_once(
    tmp_path: Path, stack: ExitStack, phone: list[str]
) -> None:
    run = Run(tmp_path, stack)
    run.telemetry.put(ROW.pack())
    service = follow(tmp_path, stack)
    service.step()
    run.process.close()
    service.step()
    assert phone == [], "one look may have met the moment between publication and lock"
    for _ in range(5):
        service.step()
    assert phone == ["control_gone"]
    service.close()
    find_again(follow(tmp_path, stack))
    assert phone == ["control_gone"]


@pytest.mark.parametrize("exit_word", ["killed", "terminated"])
def test_the_recorders_end_of_a_vanished_hold_is_no_second_alarm(
    tmp_path: Path, stack: ExitStack, phone: list[str], exit_word: str
) -> None:
    run = Run(tmp_path, stack)
    SentLog(run.folder, "hold").close()  # as the hold's own process has made it
    run.process.close()
    run.record(json.dumps({"kind": "end", "exit": exit_word, "mono_s": 9.0}))
    service = follow(tmp_path, stack)
    for _ in range(4):
        service.step()
    assert phone == ["control_gone"]


def test_a_hold_that_ended_well_is_no_alarm(
    tmp_path: Path, stack: ExitStack, phone: list[str]
) -> None:
    run = Run(tmp_path, stack)
    service = follow(tmp_path, stack)
    service.step()
    run.emit(kind="end", exit="done", mono_s=9.0)
    run.process.close()
    for _ in range(4):
        service.step()
    assert phone == []


def test_a_trip_that_was_not_sent_is_sent_by_the_next_service(
    tmp_path: Path, stack: ExitStack, phone: list[str]
) -> None:
    run = Run(tmp_path, stack)
    SentLog(run.folder, "hold").close()
    run.process.close()
    run.record(json.dumps({"kind": "end", "exit": "safety_trip", "mono_s": 9.0}))
    service = follow(tmp_path, stack)
    for _ in range(4):
        service.step()
    assert phone == ["run_ended"]


def test_an_old_end_is_no_news(tmp_path: Path, stack: ExitStack, phone: list[str]) -> None:
    run = Run(tmp_path, stack)
    run.record(json.dumps(FAULT))
    run.process.close()
    assert read_alarms_config(run.folder) is None, "no process of alarms has followed it"
    (run.folder / LOG_NAME).write_text("")
    assert read_alarms_config(run.folder) is not None
    old_s = time.time() - 1.1 * DAY_S
    os.utime(run.folder / "events.jsonl", (old_s, old_s))
    assert read_alarms_config(run.folder) is None
    service = follow(tmp_path, stack)
    service.step()
    service.step()
    assert phone == []


def test_a_run_without_addresses_is_not_followed(
    tmp_path: Path, stack: ExitStack, phone: list[str]
) -> None:
    run = Run(tmp_path, stack, alarms=False)
    service = follow(tmp_path, stack)
    service.step()
    assert not (run.folder / LOG_NAME).exists()


def test_the_next_run_is_followed_too(tmp_path: Path, stack: ExitStack, phone: list[str]) -> None:
    first = Run(tmp_path, stack)
    service = follow(tmp_path, stack)
    service.step()
    first.emit(kind="end", exit="safety_trip", mono_s=9.0)
    first.process.close()
    service.step()
    second = Run(tmp_path, stack, name="b")
    find_again(service)
    second.emit(**FAULT)
    service.step()
    assert phone == ["run_ended", "fault"]


def test_files_of_another_user_are_left_to_the_hold(
    tmp_path: Path,
    stack: ExitStack,
    phone: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def refuse(folder: Path, by: str) -> SentLog:
        raise PermissionError(13, "Permission denied", str(folder))

    run = Run(tmp_path, stack)
    monkeypatch.setattr("membrane_ctrl.service.followed_run.SentLog", refuse)
    run.emit(**FAULT)
    service = follow(tmp_path, stack)
    service.step()
    service.step()
    assert phone == []
    assert "not sent by the service" in capsys.readouterr().err


def test_a_folder_that_no_process_follows_stops_the_heartbeat(tmp_path: Path) -> None:
    folder = FolderAlarms(tmp_path / "none")
    folder.step()
    now_s = time.monotonic()
    assert is_working([folder], now_s)
    assert not is_working([folder], now_s + 200.0)


def test_a_copy_under_another_name_does_not_hide_the_run(
    tmp_path: Path, stack: ExitStack, phone: list[str]
) -> None:
    run = Run(tmp_path, stack)
    run.emit(**FAULT)
    shutil.copytree(run.folder, tmp_path / "3-copy")
    (tmp_path / "3-copy" / "events.jsonl").touch()
    (tmp_path / "3-copy" / LOG_NAME).touch()
    (run.folder / "events.jsonl").touch()
    service = follow(tmp_path, stack)
    service.step()
    assert phone == ["fault"]
    assert find_newest_run(tmp_path) == run.folder
