"""The mirror's rim in the picture: where the light ends, against where the camera's pose puts the
rim.

A circle on the mirror is an ellipse in the picture. The pose predicts points of the rim; the edge
of the light is searched along the line from the middle through each. The edge is at half the light
well inside.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.rays.geometry import Geometry, project_points
from membrane_ctrl.model.arrays import FloatArray

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
    centre_px : tuple[float, float]
        Centre of the ellipse that fits them.
    expected_px : tuple[float, float]
        Centre of the ellipse that the pose predicts.
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


def light_at(light: FloatArray, places_px: FloatArray) -> FloatArray:
    """Light (H, W) between pixels, at columns and rows (2, ...); NaN outside. SciPy's would load
    for 0.2 s.
    """
    far = np.array(light.shape[::-1]).reshape(2, *[1] * (places_px.ndim - 1)) - 1
    inside = ((places_px >= 0) & (places_px <= far)).all(axis=0)
    column, row = low = np.clip(np.floor(np.where(inside, places_px, 0.0)), 0, far - 1).astype(int)
    right, down = places_px - low
    upper, lower = (
        (1 - right) * light[k, column] + right * light[k, column + 1] for k in (row, row + 1)
    )
    return np.where(inside, (1 - down) * upper + down * lower, np.nan)


def find_outline(
    light: FloatArray, geometry: Geometry, rim_mm: float, rim_z_mm: float
) -> Outline | None:
    """Look for the rim.

    Parameters
    ----------
    light : (H, W) array
        White minus black, or the fringes' mean.
    rim_mm, rim_z_mm : float
        Radius of the rim, and the height of its plane in world (the sag).

    Returns
    -------
    Outline or None
        None if the rim is not in the picture (a stop inside it, a pattern too small to light it).
    """
    theta = 2 * np.pi * np.arange(_POINTS) / _POINTS
    circle = np.stack([rim_mm * np.cos(theta), rim_mm * np.sin(theta), np.full(_POINTS, rim_z_mm)])
    expected = project_points(geometry, circle)
    middle = expected.mean(axis=1)
    reach = np.linspace(_FROM, _TO, _SAMPLES)
    lines = middle[:, None, None] + (expected - middle[:, None])[:, :, None] * reach
    values = light_at(light, lines)
    whole = np.isfinite(values).all(axis=1)  # a line that leaves the picture is not used
    inside = np.where(whole, np.median(values[:, :10], axis=1), 0.0)
    below = values < inside[:, None] / 2
    first = np.argmax(below, axis=1)
    found = whole & below.any(axis=1) & (first > 0) & (inside > np.max(inside) / 4)
    if np.count_nonzero(found) < _LEAST_FOUND * _POINTS:
        return None
    scale = reach[first] - (reach[1] - reach[0]) / 2
    ray = expected - middle[:, None]
    rim = middle[:, None] + ray * scale
    # A rim shifted by w and scaled by ratio meets the ray at scale |ray| = ratio |ray| + (n w) / (n
    # u), with n the normal of the expected rim and u the ray's direction.
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
