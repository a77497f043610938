"""Where review may write: nowhere among what the recorder wrote."""

from __future__ import annotations

from pathlib import Path

from membrane_ctrl.errors import InputError
from membrane_ctrl.recording.column_file import FOLDER


def refuse_originals(folder: Path) -> None:
    """Raises InputError if a folder is a run's own, or its tables', whichever run that is.

    A folder of exported files has `events.jsonl`, too, and may be written again.
    """
    folder = folder.resolve()
    at = folder.parent if folder.name == FOLDER else folder
    if (at / "config.toml").exists() or any(at.glob("*.rrd")) or any(at.glob(f"{FOLDER}/*.arrows")):
        raise InputError(f"{folder}: there lies what the recorder wrote; choose another folder")
