"""Reads `summary.json` of a run; `summary` computes its content."""

from pathlib import Path
from typing import Any

from membrane_ctrl.model import (
    file_checksums,
    files,
    plain_json,
)
from membrane_ctrl.run_files.event_log import is_moment

_SUMMARY_SCHEMA = "membrane-summary/2"


def read_summary(folder: Path, notes: list[str]) -> dict[str, Any] | None:
    """Read `summary.json`, which the recorder writes at the end.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    notes : list of str
        Gets a line if it is missing or damaged, or of another schema.

    Returns
    -------
    dict or None
        None if it is missing or damaged. One of another schema is returned as it is, with the note.
    """
    path = folder / "summary.json"
    try:
        summary: Any = plain_json.loads(files.read_text(path))
    except FileNotFoundError:
        notes.append("summary.json: missing; the run is in progress, or its recorder was killed")
        return None
    except (OSError, ValueError) as error:
        notes.append(f"summary.json: cannot be read ({error})")
        return None
    # Of our schema, with its checksum, and plausible.
    if not isinstance(summary, dict) or summary.get("schema") != _SUMMARY_SCHEMA:
        notes.append(f"summary.json: not of schema {_SUMMARY_SCHEMA}; its figures are not used")
        if not isinstance(summary, dict):
            return {}
        return summary
    if not file_checksums.pop_checksum(summary):
        notes.append("summary.json: checksum mismatch (damaged or edited); it is not used")
        return None
    if not is_moment(summary.get("duration_s", 0.0) or 0.0):
        notes.append("summary.json: impossible duration_s; it is not used")
        del summary["duration_s"]
    return summary
