"""Reads the events of a run; unreadable lines are counted and skipped."""

import errno
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.model import (
    event_lines,
    events,
    file_checksums,
    files,
    plain_json,
)
from membrane_ctrl.run_files.annotations import ANNOTATIONS_FILE

# Enough for a fault campaign of months; a line is about 150 bytes.
EVENTS_BYTES_MAX = 64_000_000
_NEWEST_BYTES = 262_144  # at the end of the file: some thousand events
_RUN_MAX_S = 1e9  # thirty years


@dataclass(frozen=True, slots=True)
class LoggedEvent:
    """A line of a run's events, and what it means."""

    mono_s: float  # second of the run; 0 if the line does not state it
    event: events.Event
    line: events.EventLine


def parse_logged_line(line: events.EventLine) -> LoggedEvent:
    """What a line means; a mark made during the run (`ctl
    mark`) is recorded as a command.
    """
    event = event_lines.from_dict(line)
    if isinstance(event, events.CommandTaken) and event.command == "mark":
        line = line | {"kind": "mark", "text": event.text or event.why}
        event = event_lines.from_dict(line)
    return LoggedEvent(float(line.get("mono_s") or 0.0), event, line)


def read_events(folder: Path, notes: list[str]) -> tuple[LoggedEvent, ...]:
    """Events and annotations of a run in order of time.

    Parameters
    ----------
    folder : Path
        Folder of the run, which may be in progress.
    notes : list of str
        Gets a line if the file is missing or cannot be read, and the number of lines that are
        damaged: these are left out.
    """
    logged = _json_lines(folder / "events.jsonl", notes)
    if not (folder / "events.jsonl").exists():
        notes.append("events.jsonl: missing; states are taken from the telemetry")
    later = _json_lines(folder / ANNOTATIONS_FILE, notes)
    return tuple(sorted(map(parse_logged_line, logged + later), key=lambda each: each.mono_s))


def read_newest_lines(folder: Path) -> list[events.EventLine]:
    """The last lines of a run's events, oldest first; none if they cannot be read.

    At most the last 256 kB are read, so the time does not grow with the run.
    """
    with suppress(OSError), files.open_plain(folder / "events.jsonl") as file:
        skipped = max(0, os.fstat(file.fileno()).st_size - _NEWEST_BYTES)
        file.seek(skipped)
        lines = file.read(_NEWEST_BYTES).decode("utf-8", "replace").splitlines()
        if skipped:  # the first line is a part of one
            del lines[:1]
        return [event for event in map(event_of, lines) if event is not None]
    return []


def _json_lines(path: Path, notes: list[str]) -> list[events.EventLine]:
    """The intact events of a file; `notes` counts the others. Empty without a readable file."""
    try:
        text = files.read_text(path, EVENTS_BYTES_MAX, errors="replace")
        if plain_json.count_elements(text) > plain_json.ELEMENTS_MAX:
            raise OSError(errno.EFBIG, f"more than {plain_json.ELEMENTS_MAX} elements")
    except FileNotFoundError:
        return []
    except OSError as error:
        notes.append(f"{path.name}: cannot be read ({error.strerror})")
        return []
    lines = [event_of(line) for line in text.splitlines()]
    if broken := lines.count(None):
        notes.append(
            f"{path.name}: {broken} line{'s' * (broken > 1)} unreadable or untrustworthy: left out"
        )
    return [line for line in lines if line is not None]


def event_of(line: str) -> events.EventLine | None:
    """The event in a line, if valid: an object of a known form with a correct checksum and a
    possible time.
    """
    try:
        event = plain_json.loads(line)
    except ValueError:
        return None
    if not isinstance(event, dict) or not file_checksums.pop_checksum(event):
        return None
    moment_s = event.get("mono_s")
    right = isinstance(event.get("kind", ""), str) and (moment_s is None or is_moment(moment_s))
    return event if right else None


def is_moment(value: object) -> bool:
    """Whether a value is a possible time of a run; damaged and forged files may hold anything."""
    return (
        isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < _RUN_MAX_S
    )
