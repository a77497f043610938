"""Compares a new geometry with the one in use, and puts it in its place."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from membrane_ctrl.config import schema
from membrane_ctrl.geometry.file import GeometryFile, GeometryOrigin, read_geometry
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.model import errors, files


def compare_geometries(
    optics: schema.OpticsConfig, origin: GeometryOrigin, new: GeometryFile
) -> list[str]:
    """Lines that compare the geometry in use (`optics`, `origin`) with the new one, in numbers that
    a tape measure can check.
    """
    old = "by hand"
    if origin.calibrated_utc:
        old = f"calibrated {origin.calibrated_utc}"
    lines = [
        f"in use: {old}, hash {origin.hash}; new: hash {new.origin.hash}",
        f"{'':<28}{'in use':>12}{'new':>12}",
    ]
    before = _tape_lengths(Geometry.from_config(optics))
    after = _tape_lengths(Geometry.from_config(new.apply_to_optics(optics)))
    for name, length in before.items():
        lines.append(f"{name:<28}{length:>12.3f}{after[name]:>12.3f}")
    return lines


def _tape_lengths(geometry: Geometry) -> dict[str, float]:
    """Lengths and angles of a geometry, by what they are."""
    pinhole_mm = geometry.pinhole_mm
    screen_mm = geometry.screen_origin_mm
    height_mm = pinhole_mm[2]
    across_mm = np.hypot(pinhole_mm[0], pinhole_mm[1])

    # Angle between the screen's normal and its direction from the vertex.
    normal = np.cross(geometry.screen_s_x, geometry.screen_s_y)
    cosine = np.clip(abs(normal @ screen_mm) / np.linalg.norm(screen_mm), -1.0, 1.0)
    return {
        "a, vertex to pinhole, mm": float(np.linalg.norm(pinhole_mm)),
        "b, vertex to screen, mm": float(np.linalg.norm(screen_mm)),
        "alpha of the camera, deg": float(np.degrees(np.arctan2(height_mm, across_mm))),
        "the screen leans by, deg": float(np.degrees(np.arccos(cosine))),
    }


def adopt_geometry(new: Path, place: Path) -> Path | None:
    """Put a geometry where the configuration looks for it; returns where the previous one is kept.

    Raises DeviceError if it cannot be written; the old one then stays in place.
    """
    with errors.convert_write_errors(place, errors.DeviceError):
        place.parent.mkdir(parents=True, exist_ok=True)
        place = files.resolve_user_path(place)
        kept = None
        if place.exists():
            kept = _backup_path(place)
        if kept is not None:
            files.write_bytes_atomic(kept, files.read_bytes(place, files.SMALL_BYTES, follow=True))
        files.write_text_atomic(place, files.read_text(new))
    return kept


def _backup_path(place: Path) -> Path:
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
