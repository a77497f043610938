"""The small files of a run folder; readers name what is broken and use the rest."""

import errno
import getpass
import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from membrane_ctrl.config import toml_file
from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import errors, events, files, plain_json, program, run_events
from membrane_ctrl.run_files import run_head

# The folder of a run: `logs/<UTC time>-<name>/` with the configuration as it ran
# (docs/reference/interfaces.md).


CONFIG = "config.toml"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def create_run_folder(logs_dir: Path, name: str, started_utc: datetime, config: Config) -> Path:
    """Make `<logs_dir>/20261121T012345Z-<name>` with `run.json`, and `config.toml` including every
    default.

    A second run in the same second gets the suffix `-2`.

    Raises InputError if the name has characters other than letters, digits, dot, dash and
    underscore. Raises DeviceError, and leaves nothing behind, if the folder cannot be written or
    the disk has less than `recording.min_free_mb` free.
    """
    if not _NAME.fullmatch(name):
        raise errors.InputError(
            f"run name {name!r}: use letters, digits, '.', '-' and '_' (at most 64, no '.' "
            "in front)"
        )
    try:
        logs_dir.mkdir(parents=True, exist_ok=True)
        _require_free(logs_dir, config.recording.min_free_mb)
        run_dir = _make_unique(logs_dir, f"{started_utc.astimezone(UTC):%Y%m%dT%H%M%SZ}-{name}")
    except OSError as error:
        raise _unwritable(logs_dir, error) from None
    try:
        write_heads(run_dir, config)
    except OSError as error:
        shutil.rmtree(run_dir, ignore_errors=True)
        raise _unwritable(run_dir, error) from None
    return run_dir


def write_heads(run_dir: Path, config: Config) -> None:
    """Write `run.json`, and `config.toml` with every default. Raises OSError."""
    run_head.write_run_head(run_dir)
    text = f"# {program.program_identity()}\n{toml_file.dump(config)}"
    files.write_text_atomic(run_dir / CONFIG, plain_json.with_comment(text))


def free_mb(folder: Path) -> float:
    """Space available to us on the folder's disk in MB (1e6 bytes). Raises OSError."""
    return shutil.disk_usage(folder).free / 1e6


def _require_free(folder: Path, least_mb: float) -> None:
    left_mb = free_mb(folder)
    if left_mb < least_mb:
        raise errors.DeviceError(
            f"{folder}: only {left_mb:.0f} MB free, recording.min_free_mb requires {least_mb:.0f}; "
            "delete old runs or choose another disk with --logs"
        )


def _make_unique(logs_dir: Path, name: str) -> Path:
    for number in range(1, 1000):
        run_dir = logs_dir / (name if number == 1 else f"{name}-{number}")
        try:
            run_dir.mkdir()
        except FileExistsError:
            continue
        return run_dir
    raise FileExistsError(17, "a thousand runs of this second and name exist")


def _unwritable(folder: Path, error: OSError) -> errors.DeviceError:
    reason = errors.os_reason(error)
    return errors.DeviceError(
        f"{folder}: cannot be written ({reason}); give a writable folder with --logs DIR"
    )


# The parts that this version understands of a damaged configuration, or one of another version.


def understood(tables: dict[str, Any]) -> tuple[Config, list[str]]:
    """Return a configuration without unknown keys and invalid values, and the names of those.

    An unknown key says nothing about its neighbours: they keep their values.
    """
    tables = _copied(tables)
    left_out: list[str] = []
    while True:
        try:
            return Config.model_validate(tables), left_out
        except ValidationError as error:
            # all at once: removing ten thousand keys one by one would validate as many times
            names = [_take_out(tables, found["loc"]) for found in error.errors(include_url=False)]
        if not any(names):  # incompatible tables
            return Config(), [*left_out, "tables that do not go together"]
        left_out += filter(None, names)


def _take_out(tables: dict[str, Any], location: Sequence[int | str]) -> str:
    """Delete the deepest existing key of an error's location; returns its name, or ""."""
    inside: Any = tables
    path: list[str] = []
    found: tuple[dict[str, Any], str] | None = None
    for part in location:
        # a location contains the tag of a union's member, the file does not
        if isinstance(inside, dict) and isinstance(part, str) and part in inside:
            found = inside, part
            path.append(part)
            inside = inside[part]
        elif isinstance(inside, list) and isinstance(part, int) and part < len(inside):
            inside = inside[part]
    if found is None:
        return ""
    del found[0][found[1]]
    return ".".join(path)


def _copied(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copied(inner) for key, inner in value.items()}
    return [_copied(inner) for inner in value] if isinstance(value, list) else value


# Marks made after a run go to a separate file: the recording itself is never changed.


ANNOTATIONS_FILE = "annotations.jsonl"


def add_mark(folder: Path, origin_utc: datetime, mono_s: float, text: str) -> events.EventLine:
    """Append a mark at a time of the run; it then counts among the run's events.

    Parameters
    ----------
    folder : Path
        Of the run.
    origin_utc : datetime
        UTC at 0 s of the run.
    mono_s : float
        Time of the mark.
    text : str
        Text of the mark.

    Raises DeviceError if the folder cannot be written.
    """
    moment = datetime.fromtimestamp(origin_utc.timestamp() + mono_s, UTC)
    mark = run_events.Mark(text, _user(), made_utc=datetime.now(UTC).isoformat(timespec="seconds"))
    line = {"time_utc": moment.isoformat(), "mono_s": mono_s} | mark.to_dict()
    line["program"] = program.program_identity()
    try:
        files.append_text(folder / ANNOTATIONS_FILE, json.dumps(line, ensure_ascii=False) + "\n")
    except OSError as error:
        reason = errors.os_reason(error)
        raise errors.DeviceError(
            f"{folder / ANNOTATIONS_FILE}: cannot be written ({reason})"
        ) from None
    return line


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return ""


_SUMMARY_SCHEMA = "membrane-summary/2"
# Enough for a fault campaign of months; a line is about 150 bytes.
EVENTS_BYTES_MAX = 64_000_000
_RUN_MAX_S = 1e9  # thirty years
_NAMED_MAX = 20


def find_folder(path: Path) -> Path:
    """The run's folder, given a path to it or into it. Raises InputError if it is not a run."""
    folder = path.parent if path.is_file() else path
    if not folder.exists():
        raise errors.InputError(f"{path}: no such run; `membrane-ctrl runs` lists the runs")
    if not is_run(folder):
        raise errors.InputError(
            f"{path}: not a run: it contains neither events.jsonl nor a table of ticks"
        )
    return folder.resolve()


def is_run(folder: Path) -> bool:
    """Whether a folder contains anything of a run."""
    return folder.is_dir() and (
        (folder / "events.jsonl").exists() or any(folder.glob("ticks/ticks-*"))
    )


@dataclass(frozen=True, slots=True)
class LoggedEvent:
    """A line of a run's events, and what it means."""

    mono_s: float  # second of the run; 0 if the line does not say
    event: events.Event
    line: events.EventLine


def logged(line: events.EventLine) -> LoggedEvent:
    """What a line means; a mark made while the run went on (`ctl
    mark`) is recorded as a command.
    """
    event = run_events.from_dict(line)
    if isinstance(event, events.CommandTaken) and event.command == "mark":
        line = line | {"kind": "mark", "text": event.text or event.why}
        event = run_events.from_dict(line)
    return LoggedEvent(float(line.get("mono_s") or 0.0), event, line)


def read_events(folder: Path, notes: list[str]) -> tuple[LoggedEvent, ...]:
    """Events and annotations in order of time; `notes` counts lines that are not JSON objects."""
    told = _json_lines(folder / "events.jsonl", notes)
    if not (folder / "events.jsonl").exists():
        notes.append("events.jsonl: missing; states are taken from the telemetry")
    later = _json_lines(folder / ANNOTATIONS_FILE, notes)
    return tuple(sorted(map(logged, told + later), key=lambda each: each.mono_s))


def read_summary(folder: Path, notes: list[str]) -> dict[str, Any] | None:
    """`summary.json`; None with a note if it is missing or broken."""
    path = folder / "summary.json"
    try:
        summary: Any = plain_json.loads(files.read_text(path))
    except FileNotFoundError:
        notes.append("summary.json: missing; the run is in progress, or its recorder was killed")
        return None
    except (OSError, ValueError) as error:
        notes.append(f"summary.json: cannot be read ({error})")
        return None
    if not isinstance(summary, dict) or summary.get("schema") != _SUMMARY_SCHEMA:
        notes.append(f"summary.json: not of schema {_SUMMARY_SCHEMA}; its figures are not used")
        return {} if not isinstance(summary, dict) else summary
    if not plain_json.take_checksum(summary):
        notes.append("summary.json: checksum mismatch (damaged or edited); it is not used")
        return None
    if not is_moment(summary.get("duration_s", 0.0) or 0.0):
        notes.append("summary.json: impossible duration_s; it is not used")
        del summary["duration_s"]
    return summary


def exact_config(folder: Path) -> Config:
    """`config.toml` as it was in force. Raises InputError if this version does not understand all
    of it.
    """
    return toml_file.load(folder / "config.toml", Config, follow=False)


def read_config(folder: Path, notes: list[str]) -> Config:
    """`config.toml`; keys that this version does not understand get their defaults, with a note."""
    path = folder / "config.toml"
    notes += _config_damage(path)
    try:
        tables = toml_file.read_toml(path, follow=False)
    except errors.InputError as error:
        notes.append(f"{error}; all defaults are used")
        return Config()
    try:
        return toml_file.parse(tables, Config, "config.toml")
    except errors.InputError as error:
        config, left_out = understood(tables)
        named = ", ".join(left_out[:_NAMED_MAX]) + (
            f" and {len(left_out) - _NAMED_MAX} more" * (len(left_out) > _NAMED_MAX)
        )
        notes.append(f"{error}; omitted or at its default: {named}")
        return config


def _config_damage(path: Path) -> list[str]:
    try:
        text = files.read_text(path)
    except (OSError, ValueError):  # reported by whoever reads it
        return []
    if not text:
        return ["config.toml: empty; all defaults are used"]
    right = plain_json.comment_is_right(text)
    return (
        []
        if right
        else ["config.toml: checksum mismatch (damaged or edited); its values are doubtful"]
    )


def _json_lines(path: Path, notes: list[str]) -> list[events.EventLine]:
    try:
        text = files.read_text(path, EVENTS_BYTES_MAX, errors="replace")
        if plain_json.elements(text) > plain_json.ELEMENTS_MAX:
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
    if not isinstance(event, dict) or not plain_json.take_checksum(event):
        return None
    moment_s = event.get("mono_s")
    right = isinstance(event.get("kind", ""), str) and (moment_s is None or is_moment(moment_s))
    return event if right else None


def is_moment(value: object) -> bool:
    """Whether a value is a possible time of a run; damaged and forged files may hold anything."""
    return (
        isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < _RUN_MAX_S
    )
