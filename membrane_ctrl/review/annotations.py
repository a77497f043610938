"""Marks made after a run: a file of their own beside the recording, which itself is never touched."""

from __future__ import annotations

import getpass
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from membrane_ctrl.errors import DeviceError
from membrane_ctrl.recording.atomic import append_text

ANNOTATIONS_FILE = "annotations.jsonl"
MARK = "mark"


def add_mark(folder: Path, origin_utc: datetime, mono_s: float, text: str) -> dict[str, Any]:
    """Append a mark at a second of the run; it stands among the run's events from then on.

    Parameters
    ----------
    folder : Path
        Of the run.
    origin_utc : datetime
        UTC at 0 s of the run.
    mono_s : float
        Where the mark belongs.
    text : str
        What it says.

    Raises
    ------
    DeviceError
        If the folder cannot be written.
    """
    moment = datetime.fromtimestamp(origin_utc.timestamp() + mono_s, UTC)
    event = {
        "time_utc": moment.isoformat(),
        "mono_s": mono_s,
        "kind": MARK,
        "text": text,
        "who": _user(),
        "made_utc": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    try:
        append_text(folder / ANNOTATIONS_FILE, json.dumps(event, ensure_ascii=False) + "\n")
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise DeviceError(f"{folder / ANNOTATIONS_FILE}: cannot be written ({reason})") from None
    return event


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return ""
