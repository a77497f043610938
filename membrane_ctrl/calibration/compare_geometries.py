"""Compares a new geometry with the one in use, in numbers that a tape measure can check."""

import numpy as np

from membrane_ctrl.config import schema
from membrane_ctrl.geometry.file import GeometryFile, GeometryOrigin
from membrane_ctrl.metrology.rays.geometry import Geometry


def compare_geometries(
    optics: schema.OpticsConfig, origin: GeometryOrigin, new: GeometryFile
) -> list[str]:
    """Compare the geometry in use with a new one, in numbers that a tape measure can check.

    Parameters
    ----------
    optics, origin : OpticsConfig
        The geometry in use, and where it comes from.
    new : GeometryFile
        The new one.

    Returns
    -------
    list of str
        Lines to print.
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
