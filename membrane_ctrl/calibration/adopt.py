"""Old geometry against new, and the exchange of the files."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from membrane_ctrl.calibration.geometry_file import GeometryFile, GeometryOrigin, read_geometry
from membrane_ctrl.config import OpticsConfig
from membrane_ctrl.errors import DeviceError, InputError
from membrane_ctrl.metrology.geometry import Geometry
from membrane_ctrl.recording.atomic import (
    SMALL_BYTES,
    read_bytes,
    read_text,
    users,
    write_bytes_atomic,
    write_text_atomic,
)


def compared(optics: OpticsConfig, origin: GeometryOrigin, new: GeometryFile) -> list[str]:
    """The geometry in force beside the new one, in the numbers that a person can check with a tape.

    Parameters
    ----------
    optics : OpticsConfig
        As in force, for the sets say what they were taken with.
    origin : GeometryOrigin
        Its name.
    new : GeometryFile
    """
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
    """Put a geometry where the configuration looks for it; returns where the one before it is kept now.

    Raises
    ------
    DeviceError
        If it cannot be written; then the old one is still there.
    """
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        place = users(place)
        kept = _kept(place) if place.exists() else None
        if kept is not None:
            write_bytes_atomic(kept, read_bytes(place, SMALL_BYTES, follow=True))
        write_text_atomic(place, read_text(new))
    except OSError as error:
        raise DeviceError(f"{place}: cannot be written ({(error.strerror or str(error)).lower()})") from None
    return kept


def _kept(place: Path) -> Path:
    """A name with the date of the calibration, or of the file if a person wrote it; never one that is taken."""
    try:
        written = datetime.fromisoformat(read_geometry(place).origin.calibrated_utc)
    except (InputError, ValueError):
        written = datetime.fromtimestamp(place.stat().st_mtime, UTC)
    stem = f"{place.stem}-{written.astimezone(UTC):%Y%m%dT%H%M%SZ}"
    for number in range(1, 1000):
        kept = place.with_name(f"{stem}{'' if number == 1 else f'-{number}'}{place.suffix}")
        if not kept.exists():
            return kept
    raise OSError(f"{stem} is there a thousand times")
