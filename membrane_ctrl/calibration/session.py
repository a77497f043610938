"""A live calibration's folder `<logs>/calibration/<UTC>-<name>/` of plan, sets and results."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.config import schema
from membrane_ctrl.model import errors
from membrane_ctrl.sessions import folder as session_folder

SCHEMA = "membrane-live-calibration/1"


@dataclass(frozen=True, slots=True)
class CalibrationHead:
    """`session.json`.

    Attributes
    ----------
    source : str
        The run on which the session began.
    created_utc : str
        When the session began, ISO 8601.
    start_um : float
        Setpoint to return to; the measurements by hand are assumed valid there.
    shape_on : bool
        Whether the shape loop was on.
    setpoints_um : tuple of float
        Setpoints of the sets, in their order.
    """

    source: str
    created_utc: str
    start_um: float
    shape_on: bool
    setpoints_um: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class CalibrationSession:
    """A live calibration on disk; it continues with the missing sets."""

    path: Path
    head: CalibrationHead
    config: schema.Config

    @property
    def set_folders(self) -> tuple[Path, ...]:
        """Folders of all sets, existing or not."""
        return tuple(
            self.path / "sets" / f"set-{k + 1}" for k in range(len(self.head.setpoints_um))
        )

    @property
    def missing_indices(self) -> tuple[int, ...]:
        """Indices of the missing sets."""
        return tuple(k for k, folder in enumerate(self.set_folders) if not folder.exists())

    @property
    def geometry_path(self) -> Path:
        """Path of the result."""
        return self.path / "geometry.toml"

    def keep_set(self, index: int, taken: Path) -> None:
        """Copy a set from the run's folder, atomically: a set that is there is complete.

        Parameters
        ----------
        index : int
            Of its setpoint, from 0.
        taken : Path
            Folder of the set in the run, which stays.

        Raises
        ------
        DeviceError
            It cannot be read or written.
        """
        folder = self.set_folders[index]
        part = folder.with_name(f".{folder.name}.part")
        try:
            folder.parent.mkdir(exist_ok=True)
            shutil.rmtree(part, ignore_errors=True)
            shutil.copytree(taken, part)
            part.replace(folder)
        except (OSError, shutil.Error) as error:
            raise errors.DeviceError(
                f"{folder}: cannot copy the set {taken} here ({error})"
            ) from None


def begin_session(
    logs: Path, name: str, head: CalibrationHead, config: schema.Config
) -> CalibrationSession:
    """Begin a session in a new folder.

    Parameters
    ----------
    logs : Path
        Folder of the runs; the session goes to its `calibration`.
    name : str
        Last part of the folder's name, after the time.
    head : CalibrationHead
        What is known at its beginning; becomes `session.json`.
    config : Config
        That of the hold, stored with the session.

    Raises
    ------
    InputError
        The name cannot be a part of a folder's name.
    DeviceError
        The folder cannot be written.
    """
    return CalibrationSession(
        session_folder.begin_session(logs / "calibration", name, head, config, SCHEMA), head, config
    )


def resume_session(path: Path) -> CalibrationSession:
    """Open an existing session. Raises errors.InputError if it is not one."""
    return CalibrationSession(path, *session_folder.read_session(path, CalibrationHead, SCHEMA))
