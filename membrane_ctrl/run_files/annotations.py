"""Marks made after a run; they go to a separate file, as the recording is never changed."""

import json
from datetime import UTC, datetime
from pathlib import Path

from membrane_ctrl.model import errors, events, files, program, run_events
from membrane_ctrl.model.account import account_name

ANNOTATIONS_FILE = "annotations.jsonl"


def add_mark(
    folder: Path, origin_utc: datetime, mono_s: float, text: str, author: str = ""
) -> events.EventLine:
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
    author : str
        Who makes it; by default, the account of this program.

    Raises
    ------
    DeviceError
        The folder cannot be written.
    """
    moment = datetime.fromtimestamp(origin_utc.timestamp() + mono_s, UTC)
    mark = run_events.Mark(
        text, author or account_name(), made_utc=datetime.now(UTC).isoformat(timespec="seconds")
    )
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
