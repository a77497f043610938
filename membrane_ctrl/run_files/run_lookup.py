"""Finds the folder of a run, given a path to it or into it."""

import re
from pathlib import Path

from membrane_ctrl.model import errors

RUN_NAME = re.compile(r"(\d{8}T\d{6}Z)-.+")  # the start in UTC, and a name


def is_run_name(name: str) -> bool:
    """Whether a name is one that `create_run_folder` gives: the start in UTC, then a name.

    The newest run of a folder is the last such name. A copy under another name, such as `3-copy`,
    would hide it.
    """
    return RUN_NAME.fullmatch(name) is not None


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
