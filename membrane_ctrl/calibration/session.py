"""The folder of a live calibration, `<logs>/calibration/<UTC>-<name>/`: its plan, its sets, its geometry."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from membrane_ctrl import config_file
from membrane_ctrl.config import Config
from membrane_ctrl.errors import DeviceError, InputError
from membrane_ctrl.recording.atomic import write_text_atomic
from tuning import plain
from tuning.session_folder import fresh_folder

FORMAT = "membrane-live-calibration/1"


@dataclass(frozen=True, slots=True)
class Head:
    """`session.json`.

    Attributes
    ----------
    format, source, created_utc : str
        `source` is the run it began on.
    start_um : float
        Setpoint to come back to; what was measured by hand is taken to hold for a mirror that stands there.
    shape_on : bool
        Whether the outer loop was on.
    setpoints_um : tuple of float
        Of the sets, in their order.
    """

    format: str
    source: str
    created_utc: str
    start_um: float
    shape_on: bool
    setpoints_um: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Session:
    """A live calibration on disk; it goes on with the sets that are not there yet."""

    path: Path
    head: Head
    config: Config

    @property
    def sets(self) -> tuple[Path, ...]:
        """Folders of all sets, there or not."""
        return tuple(self.path / "sets" / f"set-{k + 1}" for k in range(len(self.head.setpoints_um)))

    @property
    def missing(self) -> tuple[int, ...]:
        """Which are not there yet."""
        return tuple(k for k, folder in enumerate(self.sets) if not folder.exists())

    @property
    def geometry(self) -> Path:
        """Where the result is."""
        return self.path / "geometry.toml"

    def keep(self, index: int, taken: Path) -> None:
        """Copy a set out of the run's folder, whole or not at all. Raises DeviceError."""
        folder = self.sets[index]
        part = folder.with_name(f".{folder.name}.part")
        try:
            shutil.rmtree(part, ignore_errors=True)
            shutil.copytree(taken, part)
            part.replace(folder)
        except (OSError, shutil.Error) as error:
            raise DeviceError(f"{folder}: the set {taken} cannot be copied there ({error})") from None


def head_of(source: str, start_um: float, shape_on: bool, setpoints_um: tuple[float, ...]) -> Head:
    """What a session that begins now is about."""
    return Head(FORMAT, source, datetime.now(UTC).isoformat(timespec="seconds"), start_um, shape_on, setpoints_um)


def begin(logs: Path, name: str, head: Head, config: Config) -> Session:
    """Make a session's folder. Raises InputError for a bad name, DeviceError if it cannot be written."""
    path = fresh_folder(logs / "calibration", name, datetime.fromisoformat(head.created_utc))
    try:
        write_text_atomic(path / "config.toml", config_file.dump(config))
        (path / "sets").mkdir()
        plain.write(path / "session.json", head)
    except OSError as error:
        raise DeviceError(f"{path}: cannot be written ({(error.strerror or str(error)).lower()})") from None
    return Session(path, head, config)


def resume(path: Path) -> Session:
    """An existing session. Raises InputError if it is none."""
    head = plain.read(path / "session.json", Head)
    if head.format != FORMAT:
        raise InputError(f"{path}/session.json: format {head.format!r}, {FORMAT!r} is known")
    return Session(path, head, config_file.load(path / "config.toml", Config))
