"""The folder of a live calibration, `<logs>/calibration/<UTC>-<name>/`: its plan, its sets, its geometry."""

import shutil
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from membrane_ctrl.config import schema
from membrane_ctrl.geometry.file import GeometryFile, GeometryOrigin, read_geometry
from membrane_ctrl.metrology.optics.geometry import Geometry
from membrane_ctrl.model import errors, files
from membrane_ctrl.sessions.folder import begin_session, read_session

FORMAT = "membrane-live-calibration/1"


@dataclass(frozen=True, slots=True)
class CalibrationHead:
    """`session.json`."""

    format: str
    source: str  # the run it started on
    created_utc: str
    # Setpoint to return to; the measurements by hand are assumed valid there
    start_um: float
    shape_on: bool  # whether the shape loop was on
    setpoints_um: tuple[float, ...]  # of the sets, in their order


@dataclass(frozen=True, slots=True)
class CalibrationSession:
    """A live calibration on disk; it continues with the missing sets."""

    path: Path
    head: CalibrationHead
    config: schema.Config

    @property
    def sets(self) -> tuple[Path, ...]:
        """Folders of all sets, existing or not."""
        return tuple(self.path / "sets" / f"set-{k + 1}" for k in range(len(self.head.setpoints_um)))

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices of the missing sets."""
        return tuple(k for k, folder in enumerate(self.sets) if not folder.exists())

    @property
    def geometry(self) -> Path:
        """Path of the result."""
        return self.path / "geometry.toml"

    def keep(self, index: int, taken: Path) -> None:
        """Copy a set from the run's folder, atomically. Raises DeviceError."""
        folder = self.sets[index]
        part = folder.with_name(f".{folder.name}.part")
        try:
            folder.parent.mkdir(exist_ok=True)
            shutil.rmtree(part, ignore_errors=True)
            shutil.copytree(taken, part)
            part.replace(folder)
        except (OSError, shutil.Error) as error:
            raise errors.DeviceError(f"{folder}: cannot copy the set {taken} here ({error})") from None


def begin(logs: Path, name: str, head: CalibrationHead, config: schema.Config) -> CalibrationSession:
    """Begin a session. Raises InputError for a bad name, DeviceError if it cannot be written."""
    return CalibrationSession(begin_session(logs / "calibration", name, head, config), head, config)


def resume(path: Path) -> CalibrationSession:
    """Open an existing session. Raises InputError if it is not one."""
    return CalibrationSession(path, *read_session(path, CalibrationHead, FORMAT))


# Comparison of old and new geometry, and the exchange of the files.


def compared(optics: schema.OpticsConfig, origin: GeometryOrigin, new: GeometryFile) -> list[str]:
    """The geometry in force (`optics`, `origin`) beside the new one, in numbers that a tape measure can check."""
    old = "by hand" if not origin.calibrated_utc else f"calibrated {origin.calibrated_utc}"
    lines = [
        f"in force: {old}, hash {origin.hash}; new: hash {new.origin.hash}",
        f"{'':<28}{'in force':>12}{'new':>12}",
    ]
    rows = zip(_by_tape(Geometry.from_config(optics)), _by_tape(Geometry.from_config(new.over(optics))), strict=True)
    lines += [f"{name:<28}{before:>12.3f}{after:>12.3f}" for (name, before), (_, after) in rows]
    return lines


def _by_tape(geometry: Geometry) -> list[tuple[str, float]]:
    pinhole, screen = geometry.pinhole_mm, geometry.screen_origin_mm
    facing = np.cross(geometry.screen_s_x, geometry.screen_s_y)
    leans = np.degrees(np.arccos(np.clip(abs(facing @ screen) / np.linalg.norm(screen), -1.0, 1.0)))
    return [
        ("a, vertex to pinhole, mm", float(np.linalg.norm(pinhole))),
        ("b, vertex to screen, mm", float(np.linalg.norm(screen))),
        ("alpha of the camera, deg", float(np.degrees(np.arctan2(pinhole[2], np.hypot(pinhole[0], pinhole[1]))))),
        ("the screen leans by, deg", float(leans)),
    ]


def adopt(new: Path, place: Path) -> Path | None:
    """Put a geometry where the configuration looks for it; returns where the previous one is kept.

    Raises DeviceError if it cannot be written; the old one then stays in place.
    """
    with errors.writing(place, errors.DeviceError):
        place.parent.mkdir(parents=True, exist_ok=True)
        place = files.users(place)
        kept = _kept(place) if place.exists() else None
        if kept is not None:
            files.write_bytes_atomic(kept, files.read_bytes(place, files.SMALL_BYTES, follow=True))
        files.write_text_atomic(place, files.read_text(new))
    return kept


def _kept(place: Path) -> Path:
    """A free name with the date of the calibration, or of the file if a person wrote it."""
    try:
        written = datetime.fromisoformat(read_geometry(place).origin.calibrated_utc)
    except (errors.InputError, ValueError):
        written = datetime.fromtimestamp(place.stat().st_mtime, UTC)
    stem = f"{place.stem}-{written.astimezone(UTC):%Y%m%dT%H%M%SZ}"
    for number in range(1, 1000):
        kept = place.with_name(f"{stem}{'' if number == 1 else f'-{number}'}{place.suffix}")
        if not kept.exists():
            return kept
    raise OSError(f"a thousand files {stem} exist")
