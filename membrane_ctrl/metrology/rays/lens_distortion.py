"""OpenCV's model of lens distortion, and its inverse."""

import cv2
import numpy as np

from membrane_ctrl.model.arrays import FloatArray

_UNDONE = 1e-9  # of a tangent: 5e-6 of a pixel of the paper's lens


def undistort_points(
    x: FloatArray, y: FloatArray, distortion: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """Normalised pinhole coordinates of distorted ones; iterated until the last digit is stable.

    NaN where the iteration does not reach the point, or reaches one beyond a fold of the model,
    where the distance from the axis falls again: no ray, or another one, belongs to such a point.
    """
    points, lens = np.stack([x.ravel(), y.ravel()], axis=1), np.array(distortion)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15)
    solved = cv2.undistortPoints(points[:, None], np.eye(3), lens, None, None, None, criteria)
    straight: FloatArray = np.asarray(solved, np.float64)[:, 0]
    back = distort_points(straight[:, 0], straight[:, 1], distortion)
    undone = np.abs(back.T - points).max(axis=1) <= _UNDONE
    straight[~undone | (np.hypot(*straight.T) > _find_fold(distortion))] = np.nan
    return straight[:, 0].reshape(x.shape), straight[:, 1].reshape(x.shape)


def _find_fold(distortion: tuple[float, ...]) -> float:
    """Distance from the axis, as a tangent, at which the lens' radial part stops growing; at most 2
    (63 degrees).
    """
    radius: FloatArray = np.linspace(0.0, 2.0, 2001)
    radial = (*distortion[:2], 0.0, 0.0, *distortion[4:])
    falls = np.diff(distort_points(radius, np.zeros_like(radius), radial)[0]) <= 0
    return float(radius[np.argmax(falls)]) if falls.any() else float(radius[-1])


def distort_points(x: FloatArray, y: FloatArray, distortion: tuple[float, ...]) -> FloatArray:
    """Distorted coordinates (2, n) of normalised pinhole ones, by OpenCV's model."""
    through = np.stack([x, y, np.ones_like(x)], axis=1)
    seen = cv2.projectPoints(through, np.zeros(3), np.zeros(3), np.eye(3), np.array(distortion))[0]
    return np.asarray(seen[:, 0].T, np.float64)
