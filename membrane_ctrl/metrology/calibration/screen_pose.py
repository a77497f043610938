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
    """Where the screen stands that the camera sees at points (2, n), about, with the stated lens.

    Raises ValueError if no plane is seen.
    """
    rays = geometry.rotation @ geometry.rays(column_px, row_px)
    seen, flat = (rays[:2] / rays[2]).T.copy(), screen_mm.T.copy()
    if flat.shape[0] <= LEAST_CORNERS:
        raise ValueError("no screen is seen")
    # a few bins may have a wrong fringe order
    good: AnyArray = np.asarray(cv2.findHomography(flat, seen, cv2.RANSAC, _PLANE_OFF)[1]).ravel()
    if np.mean(good == 1) < _PLANE_SHARE:  # also where there is none
        raise ValueError("what is seen is not a plane with fringes")
    keep = good == 1
    place = np.column_stack([flat[keep], np.zeros(np.count_nonzero(keep))])
    _, turn, shift = cv2.solvePnP(place, seen[keep], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    return SeenScreen(
        np.asarray(shift.ravel(), np.float64), np.asarray(cv2.Rodrigues(turn)[0].T, np.float64)
    )
