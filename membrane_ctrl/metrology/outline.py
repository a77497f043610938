"""The mirror's rim in the picture: where the light ends, against where the camera's pose puts the rim.

A circle on the mirror is an ellipse in the picture. The rim's points from the pose are drawn, and along the line from
the middle through each the light's edge is looked for; the edge is half the light of what is well inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from membrane_ctrl.metrology.geometry import Geometry, distort

FloatArray = NDArray[np.float64]

_POINTS = 180
_FROM, _TO = 0.85, 1.15  # of the expected radius
_SAMPLES = 121
_LEAST_FOUND = 0.4


@dataclass(frozen=True)
class Outline:
    """The rim as seen and as expected.

    Attributes
    ----------
    rim_px : (2, n) array
        Column and row of the rim's points that were found.
    centre_px, expected_px : (column, row)
        Middle of the ellipse that fits them, and of the one that the pose predicts.
    offset_mm : float
        Distance of the two, on the mirror.
    size_ratio : float
        Seen over expected, mean radius.
    """

    rim_px: FloatArray
    centre_px: tuple[float, float]
    expected_px: tuple[float, float]
    offset_mm: float
    size_ratio: float


def find_outline(light: FloatArray, geometry: Geometry, rim_mm: float, rim_z_mm: float) -> Outline | None:
    """Look for the rim.

    Parameters
    ----------
    light : (H, W) array
        White minus black, or the fringes' mean.
    rim_mm, rim_z_mm : float
        Radius of the rim, and where its plane stands in world (the sag).

    Returns
    -------
    Outline or None
        None if the rim is not in the picture (a stop inside it, a pattern too small to light it).
    """
    theta = 2 * np.pi * np.arange(_POINTS) / _POINTS
    circle = np.stack([rim_mm * np.cos(theta), rim_mm * np.sin(theta), np.full(_POINTS, rim_z_mm)])
    expected = project(geometry, circle)
    middle = expected.mean(axis=1)
    reach = np.linspace(_FROM, _TO, _SAMPLES)
    lines = middle[:, None, None] + (expected - middle[:, None])[:, :, None] * reach
    values = map_coordinates(light, [lines[1], lines[0]], order=1, mode="constant", cval=np.nan)
    whole = np.isfinite(values).all(axis=1)  # a line that leaves the picture tells nothing
    inside = np.where(whole, np.median(values[:, :10], axis=1), 0.0)
    below = values < inside[:, None] / 2
    first = np.argmax(below, axis=1)
    found = whole & below.any(axis=1) & (first > 0) & (inside > np.max(inside) / 4)
    if np.count_nonzero(found) < _LEAST_FOUND * _POINTS:
        return None
    scale = reach[first] - (reach[1] - reach[0]) / 2
    ray = expected - middle[:, None]
    rim = middle[:, None] + ray * scale
    # A rim shifted by w and scaled by ratio meets the ray at scale |ray| = ratio |ray| + (n w) / (n u), with n the
    # normal of the expected rim and u the ray's direction.
    length = np.linalg.norm(ray, axis=0)
    tangent = np.roll(expected, -1, axis=1) - np.roll(expected, 1, axis=1)
    normal = np.stack([tangent[1], -tangent[0]])
    design = np.stack([length, *(normal / np.sum(normal * ray / length, axis=0))], axis=1)[found]
    ratio, shift_x, shift_y = np.linalg.lstsq(design, (scale * length)[found], rcond=None)[0]
    rim = rim[:, found]
    mm_per_px = rim_mm / float(np.mean(np.linalg.norm(expected - middle[:, None], axis=0)))
    return Outline(
        rim_px=rim,
        centre_px=(float(middle[0] + shift_x), float(middle[1] + shift_y)),
        expected_px=(float(middle[0]), float(middle[1])),
        offset_mm=float(np.hypot(shift_x, shift_y)) * mm_per_px,
        size_ratio=float(ratio),
    )


def project(geometry: Geometry, world_mm: FloatArray) -> FloatArray:
    """Column and row (2, n) of world points (3, n), through the lens."""
    camera = geometry.rotation @ (world_mm - geometry.pinhole_mm[:, None])
    through = camera[:2] / camera[2]
    if any(geometry.distortion):
        through = distort(through[0], through[1], geometry.distortion)
    column, row = geometry.focal_px * through
    return np.stack([column + geometry.principal_px[0], row + geometry.principal_px[1]])
