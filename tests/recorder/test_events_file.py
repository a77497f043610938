"""events.jsonl: whole lines, also after a disk that was full for a while."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest

from membrane_ctrl.model.event_base import UnknownEvent
from membrane_ctrl.model.event_lines import parse_event
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.run_events import Mark
from membrane_ctrl.recorder import events_file
from membrane_ctrl.recorder.events_file import EventsFile
from membrane_ctrl.run_files.event_log import parse_logged_line


def lines(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_events_are_lines_in_their_order(tmp_path: Path) -> None:
    file = EventsFile(tmp_path / "events.jsonl")
    file.append_events([{"kind": "state", "mono_s": 1.0}, {"kind": "fault", "value": float("nan")}])
    file.append_events([{"kind": "end", "exit": 5}])
    assert [line["kind"] for line in lines(tmp_path / "events.jsonl")] == ["state", "fault", "end"]
    assert lines(tmp_path / "events.jsonl")[1]["value"] is None
    file.close()


def test_faults_and_the_end_are_synced_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", synced.append)
    file = EventsFile(tmp_path / "events.jsonl")
    file.append_events([{"kind": "state"}])
    assert len(synced) == 0
    file.append_events([{"kind": "fault"}])
    file.append_events([{"kind": "end"}])
    assert len(synced) == 2
    file.close()


def test_a_disk_that_was_full_tears_no_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real_write = os.write
    room = [25]

    def write(descriptor: int, data: bytes) -> int:
        if not room[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = real_write(descriptor, data[: room[0]])
        room[0] -= written
        return written

    monkeypatch.setattr(events_file.os, "write", write)
    file = EventsFile(tmp_path / "events.jsonl")
    with pytest.raises(OSError):
        file.append_events([{"kind": "state", "number": k} for k in range(3)])
    with pytest.raises(OSError):
        file.append_events([{"kind": "state", "number": 3}])
    room[0] = 10_000
    file.append_events([])
    assert [line["number"] for line in lines(tmp_path / "events.jsonl")] == [0, 1, 2, 3]
    file.close()


def test_too_many_waiting_events_are_counted_as_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events_file, "_WAITING_MAX", 5)
    file = EventsFile(tmp_path / "missing" / "events.jsonl")
    with pytest.raises(OSError):
        file.append_events([{"number": k} for k in range(8)])
    assert file.lost == 3
    (tmp_path / "missing").mkdir()
    file.append_events([])
    assert [line["number"] for line in lines(tmp_path / "missing" / "events.jsonl")] == [
        0,
        4,
        5,
        6,
        7,
    ]
    file.close()


@pytest.mark.parametrize("message", [b"{half", b"\xff\xfe", b"[1, 2]", b""])
def test_a_message_that_is_no_event_becomes_an_unreadable_event(message: bytes) -> None:
    assert parse_event(message)["kind"] == "unreadable_event"


@pytest.mark.parametrize(
    ("line", "event"),
    [
        (
            {"kind": "mark", "text": "door", "who": "ann", "made_utc": "now"},
            Mark("door", "ann", "now"),
        ),
        (
            {"kind": "command", "command": "mark", "text": "door", "who": "ann", "why": ""},
            Mark("door", "ann"),
        ),
        (
            {"kind": "command", "command": "mark", "who": "ann", "why": "a door"},
            Mark("a door", "ann"),
        ),
        ({"kind": "fault", "name": 3}, UnknownEvent({"mono_s": 2, "kind": "fault", "name": 3})),
    ],
)
def test_a_line_of_a_run_becomes_its_event(line: dict[str, object], event: Event) -> None:
    each = parse_logged_line({"mono_s": 2, **line})
    assert (each.mono_s, each.event) == (2.0, event)
    assert each.line["kind"] == event.kind


def test_a_line_without_a_time_stands_at_the_start() -> None:
    assert parse_logged_line({"kind": "of tomorrow", "mono_s": None}).mono_s == 0.0
