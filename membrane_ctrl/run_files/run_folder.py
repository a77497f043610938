"""The folder of a run: `logs/<UTC time>-<name>/` with the configuration as it ran.

Its files are described in docs/reference/interfaces.md.
"""

import re
import shutil
from datetime import UTC, datetime
from pathlib import Path

from membrane_ctrl.config import toml_file
from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import (
    errors,
    file_checksums,
    files,
    program,
)
from membrane_ctrl.run_files import run_head

CONFIG = "config.toml"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def create_run_folder(logs_dir: Path, name: str, started_utc: datetime, config: Config) -> Path:
    """Make the folder `<logs_dir>/20261121T012345Z-<name>` with `run.json`, and `config.toml`
    including every default.

    Parameters
    ----------
    logs_dir : Path
        Folder of the runs.
    name : str
        Letters, digits, dot, dash and underscore.
    started_utc : datetime
        Start of the run; a second run in the same second gets the suffix `-2`.
    config : Config
        As it runs.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        The name has other characters.
    DeviceError
        The folder cannot be written, or the disk has less than `recording.min_free_mb` free;
        nothing is left behind.
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
        raise _make_unwritable_error(logs_dir, error) from None
    try:
        write_heads(run_dir, config)
    except OSError as error:
        shutil.rmtree(run_dir, ignore_errors=True)
        raise _make_unwritable_error(run_dir, error) from None
    return run_dir


def write_heads(run_dir: Path, config: Config) -> None:
    """Write `run.json`, and `config.toml` with every default.

    Parameters
    ----------
    run_dir : Path
        Folder of the run.
    config : Config
        As the run has it. The file begins with a checksum in a comment, so that an edit is noticed.

    Raises
    ------
    OSError
        The folder cannot be written.
    """
    run_head.write_run_head(run_dir)
    text = f"# {program.program_identity()}\n{toml_file.dump_toml(config)}"
    files.write_text_atomic(run_dir / CONFIG, file_checksums.add_checksum_comment(text))


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


def _make_unwritable_error(folder: Path, error: OSError) -> errors.DeviceError:
    reason = errors.os_reason(error)
    return errors.DeviceError(
        f"{folder}: cannot be written ({reason}); give a writable folder with --logs DIR"
    )
