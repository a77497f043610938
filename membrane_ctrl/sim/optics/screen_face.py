"""The twin's screen face: rays continued from the screen's plane to the true face.

A ray that crosses the plane at (u, v) with tangents (a, b) to its normal is at (u + a w, v + b w)
at a distance w from the plane. On the face w = c (u^2 + v^2) + map(u, v): solved by fixed-point
iteration, each step of which gains the product of the face's slope and the tangents, a factor of 50
or more.
"""

import numpy as np
from scipy.interpolate import RectBivariateSpline

from membrane_ctrl.config.optics import (
    HeightMapConfig,
)
from membrane_ctrl.model.arrays import FloatArray

TOLERANCE_MM = 1e-11
_FACE_MAX_STEPS = 50  # a grazing ray may never converge


def project_onto_face(
    place_mm: FloatArray,
    tangents: FloatArray,
    bow_per_mm: float,
    height_map: HeightMapConfig | None,
) -> FloatArray:
    """Where rays meet the face of a screen that is not flat.

    Fixed point: the face stands off the plane by an amount at the point found last, and the ray
    moves sideways by its tangent times that.

    Parameters
    ----------
    place_mm : (2, N) array
        s_x and s_y where the rays cross the plane.
    tangents : (2, N) array
        Motion along s_x and s_y for each mm along the plane's normal.
    bow_per_mm : float
        Height of the face at a distance r is this times r^2.
    height_map : HeightMapConfig or None
        Measured heights of the face, added to the bow.

    Returns
    -------
    (2, N) array
        s_x and s_y on the face, mm.
    """
    if bow_per_mm == 0.0 and height_map is None:
        return place_mm
    spline = None
    if height_map is not None:
        spline = _make_height_spline(height_map)
    found = place_mm
    for _ in range(_FACE_MAX_STEPS):
        off_mm = bow_per_mm * np.sum(found**2, axis=0)
        if spline is not None:
            off_mm = off_mm + spline.ev(found[1], found[0])
        last, found = found, place_mm + off_mm * tangents
        if not np.nanmax(np.abs(found - last), initial=0.0) > TOLERANCE_MM:
            break
    return found


def _make_height_spline(height_map: HeightMapConfig) -> RectBivariateSpline:
    """Through the nodes, cubic along an axis with four or more of them; beyond the grid its edge's
    height continues.
    """
    rows, columns = (min(3, len(axis) - 1) for axis in (height_map.s_y_mm, height_map.s_x_mm))
    return RectBivariateSpline(
        height_map.s_y_mm, height_map.s_x_mm, height_map.heights_mm, kx=rows, ky=columns
    )
