"""`<logs>/tuning/journal.jsonl`: which gains were kept, taken back or rolled back, when, by whom and why."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from membrane_ctrl.config import LoopConfig
from membrane_ctrl.errors import InputError
from membrane_ctrl.recording import plain_json
from membrane_ctrl.recording.atomic import append_text, make_folder, read_text, sync_data
from tuning import plain

_FILE = "journal.jsonl"
What = Literal["kept", "taken_back", "rolled_back"]


@dataclass(frozen=True, slots=True)
class Entry:
    """One line.

    Attributes
    ----------
    time_utc : str
    what : str
        "kept": verified; "taken_back": the verification failed; "rolled_back": by a person.
    session, author, reason : str
    before, after : LoopConfig
        Gains before and with it; after "taken_back" those before run again.
    """

    time_utc: str
    what: What
    session: str
    author: str
    reason: str
    before: LoopConfig
    after: LoopConfig


def entry(what: What, session: str, author: str, reason: str, before: LoopConfig, after: LoopConfig) -> Entry:
    """An entry of now."""
    return Entry(datetime.now(UTC).isoformat(timespec="seconds"), what, session, author, reason, before, after)


def note(logs: Path, what: Entry) -> None:
    """Append an entry. Raises InputError where it cannot be written: a link in its place is not followed."""
    path = logs / "tuning" / _FILE
    try:
        make_folder(path.parent)
        append_text(path, json.dumps(plain.plain(what), allow_nan=False) + "\n")
        sync_data(path)
    except OSError as error:
        raise InputError(f"{path}: not noted: {error.strerror}") from None


def entries(logs: Path) -> list[Entry]:
    """All entries, oldest first; a line that was cut off is left out. Raises InputError for no plain file."""
    path = logs / "tuning" / _FILE
    try:
        text = read_text(path, errors="replace")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    found: list[Entry] = []
    for line in text.splitlines():
        try:
            found.append(plain.built(Entry, plain_json.loads(line)))
        except (ValueError, TypeError, KeyError):
            continue
    return found


def to_roll_back(logs: Path) -> Entry:
    """The newest gains that were kept and not rolled back since. Raises InputError if there are none."""
    undone: set[str] = set()
    for found in reversed(entries(logs)):
        if found.what == "rolled_back":
            undone.add(found.session)
        elif found.what == "kept" and found.session not in undone:
            return found
    raise InputError(f"{logs / 'tuning' / _FILE}: no kept gains to roll back")


def history_table(found: list[Entry]) -> str:
    """The journal as a Markdown table."""
    lines = [
        "| time | what | session | author | K 1/s | Ti s | filter s | reason |",
        "|---|---|---|---|---:|---:|---:|---|",
    ]
    for line in found:
        loop = line.before if line.what == "rolled_back" else line.after
        lines.append(
            f"| {line.time_utc} | {line.what} | {line.session} | {line.author} | {loop.kp_per_s:.3f} "
            f"| {loop.ti_s:.2f} | {loop.measurement_filter_s:.2f} | {line.reason} |"
        )
    return "\n".join(lines)
