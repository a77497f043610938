"""OpenCV's model of lens distortion, and its inverse."""

import cv2
import numpy as np

from membrane_ctrl.model.arrays import FloatArray

_LARGEST_ERROR = 1e-9  # of a tangent: 5e-6 of a pixel of the paper's lens


def undistort_points(
    x: FloatArray, y: FloatArray, distortion: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """Invert the lens distortion; iterated until the last digit is stable.

    Parameters
    ----------
    x, y : (...) arrays
        Distorted coordinates, as tangents.
    distortion : tuple of float
        OpenCV's coefficients.

    Returns
    -------
    x, y : (...) arrays
        Normalised pinhole coordinates. NaN where the iteration does not reach the point, or reaches
        one beyond a fold of the model, where the distance from the axis falls again: no ray, or
        another one, belongs to such a point.
    """
    # OpenCV's iteration, which takes no empty array.
    if x.size == 0:
        return x.copy(), y.copy()
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    coefficients = np.array(distortion)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15)
    solved = cv2.undistortPoints(
        points[:, None], np.eye(3), coefficients, None, None, None, criteria
    )
    straight: FloatArray = np.asarray(solved, np.float64)[:, 0]

    # Its result counts only if the lens maps it back to the point, from before the fold.
    back = distort_points(straight[:, 0], straight[:, 1], distortion)
    error = np.abs(back.T - points).max(axis=1)
    is_inverse = error <= _LARGEST_ERROR
    is_beyond_fold = np.hypot(straight[:, 0], straight[:, 1]) > _find_fold(distortion)
    straight[~is_inverse | is_beyond_fold] = np.nan
    return straight[:, 0].reshape(x.shape), straight[:, 1].reshape(x.shape)


def _find_fold(distortion: tuple[float, ...]) -> float:
    """Distance from the axis, as a tangent, at which the lens' radial part stops growing; at most 2
    (63 degrees).
    """
    # The radial part, along x: without the tangential coefficients p1 and p2.
    radius: FloatArray = np.linspace(0.0, 2.0, 2001)
    radial_alone = (*distortion[:2], 0.0, 0.0, *distortion[4:])
    distorted = distort_points(radius, np.zeros_like(radius), radial_alone)[0]
    falls = np.diff(distorted) <= 0
    if not falls.any():
        return float(radius[-1])
    return float(radius[np.argmax(falls)])


def distort_points(x: FloatArray, y: FloatArray, distortion: tuple[float, ...]) -> FloatArray:
    """Return where a lens images points, by OpenCV's model.

    Parameters
    ----------
    x, y : (n,) arrays
        Normalised coordinates of a pinhole camera: tangents of the angles to the axis.
    distortion : tuple of float
        k1, k2, p1, p2[, k3[, k4, k5, k6]].

    Returns
    -------
    (2, n) array
        Normalised coordinates in the picture.
    """
    points = np.stack([x, y, np.ones_like(x)], axis=1)
    no_turn = np.zeros(3)
    no_shift = np.zeros(3)
    projected = cv2.projectPoints(points, no_turn, no_shift, np.eye(3), np.array(distortion))[0]
    return np.asarray(projected[:, 0].T, np.float64)
