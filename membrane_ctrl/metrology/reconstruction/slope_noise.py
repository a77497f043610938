"""Linear uncertainty of one cycle from white noise of the phase.

cov(parameters) = M^-1 (var_x M_x + var_y M_y) M^-1 with M = M_x + M_y = D^T W D.
"""

import math

import numpy as np

from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.reconstruction.normal_matrix import NormalMatrix
from membrane_ctrl.model.arrays import FloatArray

QUANTISATION_VARIANCE_ADU2 = 1 / 12  # of a value rounded to an integer


def pixel_sigma_adu(noise_adu: float) -> float:
    """Noise of a pixel with the rounding of its converter."""
    return math.sqrt(noise_adu**2 + QUANTISATION_VARIANCE_ADU2)


def slope_per_screen(geometry: Geometry, radius_mm: float, sag_mm: float) -> FloatArray:
    """Mean over the mirror of (d g_i / d s_k)^2 in 1/mm^2, (2, 2): rows the slopes x and y, columns
    s_x and s_y.

    The normal is n = u - d with u the unit vector to the screen point, so d n = (e - u (u e)) / |q|
    d s and g = -n_xy / n_z gives d g = -(d n_xy + g d n_z) / n_z. Taken on a bowl of the given sag,
    each point towards the screen point that it really reflects (its normal is then the bowl's own).
    """
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-0.9, 0.9, 15) * radius_mm] * 2))
    inside = np.hypot(x, y) <= 0.95 * radius_mm
    x, y = x[inside], y[inside]
    point = np.stack([x, y, sag_mm * (x**2 + y**2) / radius_mm**2])
    d = point - geometry.pinhole_mm[:, None]
    d /= np.linalg.norm(d, axis=0)
    n = np.stack([-2 * sag_mm * x / radius_mm**2, -2 * sag_mm * y / radius_mm**2, np.ones_like(x)])
    u = d - 2 * np.sum(d * n, axis=0) / np.sum(n * n, axis=0) * n
    face = np.cross(geometry.screen_s_x, geometry.screen_s_y)
    reach = (face @ (geometry.screen_origin_mm[:, None] - point)) / (face @ u)
    normal = u - d
    squares = np.empty((2, 2))
    for k, axis in enumerate((geometry.screen_s_x, geometry.screen_s_y)):
        turn = (axis[:, None] - u * (axis @ u)) / reach
        slopes = -(turn[:2] - normal[:2] / normal[2] * turn[2]) / normal[2]
        squares[:, k] = np.mean(slopes**2, axis=1)
    return squares


def parameter_covariance(normal: NormalMatrix, slope_variance: FloatArray) -> FloatArray:
    """Covariance (parameters, parameters) in mm^2 of the fit, for the variance (2,) of an x and of
    a y slope.
    """
    variance_x, variance_y = slope_variance
    return np.asarray(
        normal.inverse @ (variance_x * normal.x + variance_y * normal.y) @ normal.inverse
    )
