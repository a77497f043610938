"""The small files of a run folder, read so that what is broken is named and the rest is used."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

from membrane_ctrl.config import Config
from membrane_ctrl.config_file import parse, read_toml
from membrane_ctrl.errors import InputError
from membrane_ctrl.recording import plain_json
from membrane_ctrl.recording.atomic import read_text
from membrane_ctrl.recording.checked_text import comment_is_right, take_checksum
from membrane_ctrl.recording.column_file import FOLDER
from membrane_ctrl.review.annotations import ANNOTATIONS_FILE, MARK
from membrane_ctrl.review.understood import understood

_SUMMARY_SCHEMA = "membrane-summary/1"
# A fault campaign of months; a line is some 150 bytes.
EVENTS_BYTES_MAX = 64_000_000
_RUN_MAX_S = 1e9  # thirty years
_NAMED_MAX = 20


def find_folder(path: Path) -> Path:
    """The run's folder for a path to it or into it. Raises InputError if it is not a run."""
    folder = path.parent if path.is_file() else path
    if not folder.exists():
        raise InputError(f"{path}: no such run; `membrane-ctrl runs` lists those there are")
    if not is_run(folder):
        raise InputError(f"{path}: not a run: neither events.jsonl nor a recording is in it")
    return folder.resolve()


def is_run(folder: Path) -> bool:
    """Whether a folder holds anything of a run."""
    return folder.is_dir() and (
        (folder / "events.jsonl").exists() or any(folder.glob("*.rrd")) or any(folder.glob(f"{FOLDER}/*.arrows"))
    )


def read_events(folder: Path, notes: list[str]) -> tuple[dict[str, Any], ...]:
    """Events and annotations in the order of time; lines that are no JSON object are counted in `notes`."""
    events = _json_lines(folder / "events.jsonl", notes)
    if not (folder / "events.jsonl").exists():
        notes.append("events.jsonl: missing; states are taken from the telemetry")
    later = _json_lines(folder / ANNOTATIONS_FILE, notes)
    return tuple(sorted(events + later, key=event_s))


def read_summary(folder: Path, notes: list[str]) -> dict[str, Any] | None:
    """`summary.json`; None with a note if it is missing or broken."""
    path = folder / "summary.json"
    try:
        summary: Any = plain_json.loads(read_text(path))
    except FileNotFoundError:
        notes.append("summary.json: missing; the run is still going, or its recorder was killed")
        return None
    except (OSError, ValueError) as error:
        notes.append(f"summary.json: cannot be read ({error})")
        return None
    if not isinstance(summary, dict) or summary.get("schema") != _SUMMARY_SCHEMA:
        notes.append(f"summary.json: not of schema {_SUMMARY_SCHEMA}; its figures are not used")
        return {} if not isinstance(summary, dict) else summary
    if not take_checksum(summary):
        notes.append("summary.json: does not fit its checksum (damaged or edited); it is not used")
        return None
    if not is_moment(summary.get("duration_s", 0.0) or 0.0):
        notes.append("summary.json: duration_s is no time of a run; it is not used")
        del summary["duration_s"]
    return summary


def read_config(folder: Path, notes: list[str]) -> Config:
    """`config.toml`; keys that this version does not understand are at their defaults, with a note."""
    path = folder / "config.toml"
    notes += _config_damage(path)
    try:
        tables = read_toml(path, follow=False)
    except InputError as error:
        notes.append(f"{error}; everything is taken at its default")
        return Config()
    try:
        return parse(tables, Config, "config.toml")
    except InputError as error:
        config, left_out = understood(tables)
        named = ", ".join(left_out[:_NAMED_MAX]) + (
            f" and {len(left_out) - _NAMED_MAX} more" * (len(left_out) > _NAMED_MAX)
        )
        notes.append(f"{error}; left out, or taken at its default: {named}")
        return config


def _config_damage(path: Path) -> list[str]:
    try:
        text = read_text(path)
    except (OSError, ValueError):  # said by who reads it
        return []
    if not text:
        return ["config.toml: empty; everything is taken at its default"]
    right = comment_is_right(text)
    return [] if right else ["config.toml: does not fit its checksum (damaged or edited); its values are doubtful"]


def _json_lines(path: Path, notes: list[str]) -> list[dict[str, Any]]:
    try:
        text = read_text(path, EVENTS_BYTES_MAX, errors="replace")
        if plain_json.elements(text) > plain_json.ELEMENTS_MAX:
            raise OSError(errno.EFBIG, f"more than {plain_json.ELEMENTS_MAX} elements")
    except FileNotFoundError:
        return []
    except OSError as error:
        notes.append(f"{path.name}: cannot be read ({error.strerror})")
        return []
    found, broken = [], 0
    for line in text.splitlines():
        event = event_of(line)
        if event is not None:
            found.append(_mark(event))
        else:
            broken += 1
    if broken:
        notes.append(f"{path.name}: {broken} line{'s' * (broken > 1)} cannot be read, or not trusted: left out")
    return found


def event_of(line: str) -> dict[str, Any] | None:
    """The event in a line, if it is one: an object that fits its checksum, of a known form and a time that can be."""
    try:
        event = plain_json.loads(line)
    except ValueError:
        return None
    if not isinstance(event, dict) or not take_checksum(event) or not isinstance(event.get("kind", ""), str):
        return None
    moment_s = event.get("mono_s")
    return event if moment_s is None or is_moment(moment_s) else None


def is_moment(value: object) -> bool:
    """Whether a value is a second that a run can have; what a damaged or forged file says need not be."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < _RUN_MAX_S


def _mark(event: dict[str, Any]) -> dict[str, Any]:
    """A mark made while the run went on (`ctl mark`) is recorded as a command; here it is what it means."""
    if event.get("kind") == "command" and event.get("command") == MARK:
        return event | {"kind": MARK, "text": event.get("text") or event.get("why") or ""}
    return event


def event_s(event: dict[str, Any]) -> float:
    """Second of the run of an event; 0 of one that does not say."""
    return float(event.get("mono_s") or 0.0)
