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

_POINTS = 180  # of the rim
_FROM = 0.85  # of the expected radius, where a line of the search begins
_TO = 1.15  # and where it ends
_SAMPLES = 121  # on each line
_INSIDE_SAMPLES = 10  # of them, from the line's begin: well inside the rim
_LEAST_LIGHT = 1 / 4  # of the brightest line; a darker one does not show the mirror
_LEAST_FOUND = 0.4  # share of the points


@dataclass(frozen=True)
class Outline:
    """The rim in the picture, and where the pose expects it.

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
    """Interpolate the light between pixels, linearly along columns and rows.

    SciPy's function would load for 0.2 s.

    Parameters
    ----------
    light : (H, W) array
        Light of the pixels.
    places_px : (2, ...) array
        Columns and rows.

    Returns
    -------
    (...) array
        NaN outside the picture.
    """
    # The pixel at the upper left of each place, and the place's distance from it.
    axes = [1] * (places_px.ndim - 1)
    last_px = np.array(light.shape[::-1]).reshape(2, *axes) - 1
    inside = ((places_px >= 0) & (places_px <= last_px)).all(axis=0)
    whole_px = np.floor(np.where(inside, places_px, 0.0))
    corner_px = np.clip(whole_px, 0, last_px - 1).astype(int)
    column, row = corner_px
    right, down = places_px - corner_px

    # Between its columns, in its row and in the one below; then between these two.
    upper = (1 - right) * light[row, column] + right * light[row, column + 1]
    lower = (1 - right) * light[row + 1, column] + right * light[row + 1, column + 1]
    return np.where(inside, (1 - down) * upper + down * lower, np.nan)


def find_outline(
    light: FloatArray, geometry: Geometry, rim_mm: float, rim_z_mm: float
) -> Outline | None:
    """Look for the rim.

    Parameters
    ----------
    light : (H, W) array
        White minus black, or the fringes' mean.
    geometry : Geometry
        Pose and lens of the camera.
    rim_mm, rim_z_mm : float
        Radius of the rim, and the height of its plane in world (the sag).

    Returns
    -------
    Outline or None
        None if the rim is not in the picture (a stop inside it, a pattern too small to light it).
    """
    # The expected rim in the picture, and the lines from its middle through each of its points.
    theta = 2 * np.pi * np.arange(_POINTS) / _POINTS
    height_mm = np.full(_POINTS, rim_z_mm)
    circle_mm = np.stack([rim_mm * np.cos(theta), rim_mm * np.sin(theta), height_mm])
    expected = project_points(geometry, circle_mm)
    middle = expected.mean(axis=1)
    spoke = expected - middle[:, None]
    reach = np.linspace(_FROM, _TO, _SAMPLES)
    places_px = middle[:, None, None] + spoke[:, :, None] * reach
    values = light_at(light, places_px)

    # On each line, the first sample with less than half the light well inside. A line that leaves
    # the picture, or begins in the dark, gives none.
    is_whole = np.isfinite(values).all(axis=1)
    inside = np.where(is_whole, np.median(values[:, :_INSIDE_SAMPLES], axis=1), 0.0)
    is_dark = values < inside[:, None] / 2
    first_dark = np.argmax(is_dark, axis=1)
    is_lit = inside > np.max(inside) * _LEAST_LIGHT
    found = is_whole & is_dark.any(axis=1) & (first_dark > 0) & is_lit
    if np.count_nonzero(found) < _LEAST_FOUND * _POINTS:
        return None
    half_sample = (reach[1] - reach[0]) / 2
    scale = reach[first_dark] - half_sample  # of the edge, in expected radii

    # Ratio and shift (x, y) of the rim by least squares. A rim shifted by w and scaled by ratio
    # meets the line at scale |spoke| = ratio |spoke| + (n w) / (n u), with n the normal of the
    # expected rim and u the line's direction.
    length = np.linalg.norm(spoke, axis=0)
    tangent = np.roll(expected, -1, axis=1) - np.roll(expected, 1, axis=1)
    normal = np.stack([tangent[1], -tangent[0]])
    by_shift = normal / np.sum(normal * spoke / length, axis=0)
    design = np.stack([length, by_shift[0], by_shift[1]], axis=1)
    edge_px = scale * length
    solution = np.linalg.lstsq(design[found], edge_px[found], rcond=None)[0]
    ratio, shift_x, shift_y = solution
    mm_per_px = rim_mm / float(np.mean(length))
    return Outline(
        rim_px=middle[:, None] + spoke[:, found] * scale[found],
        centre_px=(float(middle[0] + shift_x), float(middle[1] + shift_y)),
        expected_px=(float(middle[0]), float(middle[1])),
        offset_mm=float(np.hypot(shift_x, shift_y)) * mm_per_px,
        size_ratio=float(ratio),
    )
