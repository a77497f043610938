"""Deletes runs that are too old or too large in total, except the present one and kept ones."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from membrane_ctrl.model.files import folder_handle
from membrane_ctrl.run_files.run_lookup import RUN_NAME

_DOOMED = ".deleted-"
_KEEP = ".keep"
# A clock that is wrong by years must not delete every run.
_NEVER_TOO_OLD = 3
# A run without a summary may still be running, unless it has not changed for this long.
_ABANDONED_AFTER = timedelta(hours=24)


@dataclass(frozen=True, slots=True)
class OldRun:
    """A run folder that may be deleted; its name begins with its start time."""

    folder: Path
    started_utc: datetime
    size_bytes: int


def list_deletable_runs(logs_dir: Path, present: Path, now_utc: datetime) -> list[OldRun]:
    """Runs of a folder that may be deleted, oldest first.

    Considers only folders that look like a run: a name that begins with a time, and `config.toml`.
    Left out are symbolic links, whose targets are elsewhere, runs that may still be in progress,
    and those with a file `.keep`.

    Parameters
    ----------
    logs_dir : Path
        Folder of the runs.
    present : Path
        The run of the caller, which is never deleted.
    now_utc : datetime
        A run without a summary that has changed within a day before this may be in progress.
    """
    found = []
    for folder in sorted(logs_dir.iterdir()):
        match = RUN_NAME.fullmatch(folder.name)
        if not match or folder.is_symlink() or not (folder / "config.toml").is_file():
            continue
        if folder.resolve() == present.resolve():
            continue
        if (folder / _KEEP).exists() or _may_run(folder, now_utc):
            continue
        try:
            started = datetime.strptime(match[1], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
        except ValueError:  # digits, but not a time
            continue
        found.append(OldRun(folder, started, size_bytes(folder)))
    return found


def size_bytes(folder: Path) -> int:
    """Bytes of all files below a folder; files deleted meanwhile count as nothing."""
    total = 0
    for path in folder.rglob("*"):
        try:
            total += path.lstat().st_size
        except OSError:
            continue
    return total


def _may_run(folder: Path, now_utc: datetime) -> bool:
    if (folder / "summary.json").exists():
        return False
    try:
        newest_s = max(path.lstat().st_mtime for path in folder.iterdir())
    except OSError:  # something changed meanwhile: somebody is at work there
        return True
    return now_utc - datetime.fromtimestamp(newest_s, UTC) < _ABANDONED_AFTER


def find_expired(
    runs: Sequence[OldRun],
    present_bytes: int,
    keep_gb: float | None,
    keep_days: float | None,
    now_utc: datetime,
) -> list[tuple[OldRun, str]]:
    """Return the runs to delete, each with the reason.

    Parameters
    ----------
    runs : sequence of OldRun
        Oldest first; the newest three are never too old.
    present_bytes : int
        Of the present run: they count, but it stays.
    keep_gb, keep_days : float or None
        `recording.keep_gb` and `keep_days`; None: no limit.
    now_utc : datetime
        Ages count until this moment.
    """
    # Oldest first, until age and size are within their limits.
    total = present_bytes + sum(run.size_bytes for run in runs)
    expired: list[tuple[OldRun, str]] = []
    for place, run in enumerate(runs):
        old_enough = place < len(runs) - _NEVER_TOO_OLD
        if (
            keep_days is not None
            and old_enough
            and now_utc - run.started_utc > timedelta(days=keep_days)
        ):
            expired.append((run, f"older than recording.keep_days = {keep_days:g}"))
        elif keep_gb is not None and total > keep_gb * 1e9:
            expired.append((run, f"all runs exceed recording.keep_gb = {keep_gb:g}"))
        else:
            continue
        total -= run.size_bytes
    return expired


def delete_run(run: OldRun) -> None:
    """Delete a run; rename it first, so that a crash leaves nothing that looks like a run. Raises
    OSError.
    """
    doomed = f"{_DOOMED}{run.folder.name}"
    with folder_handle(run.folder.parent.resolve()) as logs:
        os.rename(run.folder.name, doomed, src_dir_fd=logs, dst_dir_fd=logs)
        shutil.rmtree(doomed, dir_fd=logs)  # deletes links, not their targets


def delete_remains(logs_dir: Path) -> None:
    """Delete the remains of a crash in `delete_run`, as far as possible now."""
    for doomed in logs_dir.glob(f"{_DOOMED}*"):
        shutil.rmtree(doomed, ignore_errors=True)
