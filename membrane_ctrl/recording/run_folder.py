"""The folder of a run: `logs/<UTC time>-<name>/` with the configuration as it ran (INTERFACES section 6)."""

from __future__ import annotations

import re
import shutil
from datetime import UTC, datetime
from pathlib import Path

from membrane_ctrl import config_file
from membrane_ctrl.config import Config
from membrane_ctrl.errors import DeviceError, InputError
from membrane_ctrl.recording.atomic import write_text_atomic
from membrane_ctrl.recording.checked_text import with_comment

CONFIG = "config.toml"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def create_run_folder(logs_dir: Path, name: str, started_utc: datetime, config: Config) -> Path:
    """Make the run's folder and write `config.toml` into it, every default written out.

    Parameters
    ----------
    logs_dir : Path
        Where runs go; made if it is not there.
    name : str
        Letters, digits, dot, dash and underscore.
    started_utc : datetime
        The run's start, aware.
    config : Config
        As run.

    Returns
    -------
    Path
        `<logs_dir>/20261121T012345Z-<name>`; a second run in the same second gets `-2` behind it.

    Raises
    ------
    InputError
        If the name is not one.
    DeviceError
        If the folder cannot be written or the disk has less than `recording.min_free_mb` free: one line that
        names the folder and the remedy. Nothing is left behind.
    """
    if not _NAME.fullmatch(name):
        raise InputError(f"run name {name!r}: use letters, digits, '.', '-' and '_' (at most 64, no '.' in front)")
    try:
        logs_dir.mkdir(parents=True, exist_ok=True)
        _require_free(logs_dir, config.recording.min_free_mb)
        run_dir = _make_unique(logs_dir, f"{started_utc.astimezone(UTC):%Y%m%dT%H%M%SZ}-{name}")
    except OSError as error:
        raise _unwritable(logs_dir, error) from None
    try:
        write_config(run_dir, config)
    except OSError as error:
        shutil.rmtree(run_dir, ignore_errors=True)
        raise _unwritable(run_dir, error) from None
    return run_dir


def write_config(run_dir: Path, config: Config) -> None:
    """Write `config.toml`, every default written out. Raises OSError."""
    write_text_atomic(run_dir / CONFIG, with_comment(config_file.dump(config)))


def free_mb(folder: Path) -> float:
    """Space left for us on the folder's disk in MB (1e6 bytes). Raises OSError."""
    return shutil.disk_usage(folder).free / 1e6


def _require_free(folder: Path, least_mb: float) -> None:
    left_mb = free_mb(folder)
    if left_mb < least_mb:
        raise DeviceError(
            f"{folder}: only {left_mb:.0f} MB free, recording.min_free_mb asks for {least_mb:.0f}; "
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
    raise FileExistsError(17, "a thousand runs of this second and name are there")


def _unwritable(folder: Path, error: OSError) -> DeviceError:
    reason = (error.strerror or str(error)).lower()
    return DeviceError(f"{folder}: cannot be written ({reason}); give a folder you may write with --logs DIR")
