"""Approximate pose of a screen that the camera sees directly."""

import cv2
import numpy as np

from membrane_ctrl.metrology.calibration.board_lens import LEAST_CORNERS
from membrane_ctrl.metrology.rays.artefacts import SeenScreen
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.model.arrays import AnyArray, FloatArray

_PLANE_OFF = 5e-3  # of a tangent: what the stated lens leaves, far less than a fringe
_PLANE_SHARE = 0.8


def screen_seen(
    geometry: Geometry, column_px: FloatArray, row_px: FloatArray, screen_mm: FloatArray
) -> SeenScreen:
    """Find the approximate pose of a screen that the camera sees directly, with the stated lens.

    Parameters
    ----------
    geometry : Geometry
        The stated camera.
    column_px, row_px : (n,) arrays
        Points of the picture.
    screen_mm : (2, n) array
        The screen points seen there.

    Returns
    -------
    SeenScreen

    Raises
    ------
    ValueError
        If no plane is seen.
    """
    # The points as tangents, without the lens' distortion.
    rays = geometry.rotation @ geometry.rays(column_px, row_px)
    seen = (rays[:2] / rays[2]).T.copy()
    on_screen = screen_mm.T.copy()
    if on_screen.shape[0] <= LEAST_CORNERS:
        raise ValueError("no screen is seen")

    # A plane is seen in perspective, but for a few bins that may have a wrong fringe order. There
    # may be none: then no point fits.
    found = cv2.findHomography(on_screen, seen, cv2.RANSAC, _PLANE_OFF)[1]
    flags: AnyArray = np.asarray(found).ravel()
    is_good = flags == 1
    if np.mean(is_good) < _PLANE_SHARE:
        raise ValueError("what is seen is not a plane with fringes")

    # The pose of that plane before the camera.
    in_plane = on_screen[is_good]
    place = np.column_stack([in_plane, np.zeros(len(in_plane))])
    _, turn, shift = cv2.solvePnP(place, seen[is_good], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    origin_mm = np.asarray(shift.ravel(), np.float64)
    axes = np.asarray(cv2.Rodrigues(turn)[0].T, np.float64)
    return SeenScreen(origin_mm, axes)
