"""Deletes old runs by the recorder's retention rule."""

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from membrane_ctrl.model import errors
from membrane_ctrl.review.catalogue import require_folder
from membrane_ctrl.run_files import retention


def to_prune(
    logs_dir: Path, now_utc: datetime, keep_days: float | None, keep_gb: float | None
) -> list[tuple[retention.OldRun, str]]:
    """List the runs that the recorder's retention rule (`retention`) would delete.

    Parameters
    ----------
    logs_dir : Path
        Folder of the runs.
    now_utc : datetime
        From which the age counts.
    keep_days : float or None
        Largest age of a run; None: no limit.
    keep_gb : float or None
        Disk space of all runs, in 1e9 bytes; None: no limit.

    Returns
    -------
    list of (OldRun, str)
        Oldest first, each with the reason.

    Raises
    ------
    InputError
        There is no such folder, or neither limit.
    """
    require_folder(logs_dir)
    if keep_days is None and keep_gb is None:
        raise errors.InputError("runs prune: give --keep-days, --keep-gb or both")
    runs = retention.list_deletable_runs(logs_dir, logs_dir / "none", now_utc)
    return retention.find_expired(runs, 0, keep_gb, keep_days, now_utc)


def prune_runs(runs: Sequence[retention.OldRun]) -> dict[Path, str]:
    """Delete the folders of runs, skipping undeletable ones. Returns those that stay, and why."""
    stay: dict[Path, str] = {}
    for run in runs:
        try:
            retention.delete_run(run)
        except OSError as error:
            stay[run.folder] = errors.os_reason(error)
    return stay
