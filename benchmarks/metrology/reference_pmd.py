"""The paper's method, written plainly in NumPy: the reference for speed, and a second opinion on
accuracy.

Every pixel, four-step arctangent, 2N x 36 design matrix rebuilt at each of five iterations, normal
equations solved as a whole. Two things cannot be taken as printed: the matrix with piston is
singular, so piston is left out here too, and the slopes are computed from exact vectors, which is
cheaper than the paper's chain of angles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

FloatArray = NDArray[np.float64]
ITERATIONS = 5
_CHUNK = 200_000  # rows of the design matrix at a time: all 4.3 million at once are 1.2 GB


def wrapped_phases(frames: list[NDArray[np.uint8]]) -> FloatArray:
    """The paper's eq. 1 for x and y on whole frames, (2, height, width)."""
    out = []
    for axis in range(2):
        i1, i2, i3, i4 = (frame.astype(np.float64) for frame in frames[4 * axis : 4 * axis + 4])
        out.append(np.arctan2(i4 - i2, i1 - i3))
    return np.stack(out)


def design(x: FloatArray, y: FloatArray, radius_mm: float) -> FloatArray:
    """Derivatives of all terms but piston at some points, (2 n, terms - 1):
    the paper's matrix D.
    """
    rho_x, rho_y = zernike.evaluate_gradients(x / radius_mm, y / radius_mm)
    return np.concatenate([rho_x[1:], rho_y[1:]], axis=1).T / radius_mm


def reconstruct(
    geometry: Geometry,
    rays: FloatArray,
    screen_mm: FloatArray,
    radius_mm: float,
    start_sag_mm: float = 40.0,
) -> FloatArray:
    """Coefficients (terms,) in mm from rays (3, n) and screen points (2, n) of every pixel."""
    coeffs = np.zeros(ZERNIKE_TERMS)
    target = geometry.screen_points(screen_mm)
    pinhole = geometry.pinhole_mm[:, None]
    t = -geometry.pinhole_mm[2] / rays[2]
    for iteration in range(ITERATIONS):
        x, y = (pinhole + t * rays)[:2]
        height = (
            start_sag_mm * (x**2 + y**2) / radius_mm**2
            if iteration == 0
            else _height(coeffs, x, y, radius_mm)
        )
        t = (height - geometry.pinhole_mm[2]) / rays[2]
        p = pinhole + t * rays
        to_screen = target - p
        normal = to_screen / np.linalg.norm(to_screen, axis=0) - rays
        coeffs[1:] = _least_squares(
            p[0], p[1], -normal[0] / normal[2], -normal[1] / normal[2], radius_mm
        )
        coeffs[0] = -coeffs[1:] @ zernike.at_vertex()[1:]
    return coeffs


def _least_squares(
    x: FloatArray, y: FloatArray, gx: FloatArray, gy: FloatArray, radius_mm: float
) -> FloatArray:
    slopes = ZERNIKE_TERMS - 1  # piston has none
    matrix, right = np.zeros((slopes, slopes)), np.zeros(slopes)
    for first in range(0, x.size, _CHUNK):
        part = slice(first, first + _CHUNK)
        d = design(x[part], y[part], radius_mm)
        matrix += d.T @ d
        right += d.T @ np.concatenate([gx[part], gy[part]])
    return np.linalg.solve(matrix, right)


def _height(coeffs: FloatArray, x: FloatArray, y: FloatArray, radius_mm: float) -> FloatArray:
    out = np.empty_like(x)
    for first in range(0, x.size, _CHUNK):
        part = slice(first, first + _CHUNK)
        out[part] = coeffs @ zernike.evaluate_terms(x[part] / radius_mm, y[part] / radius_mm)
    return out
