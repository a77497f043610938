"""Linear uncertainty of one cycle from white noise of the phase.

cov(parameters) = M^-1 (var_x M_x + var_y M_y) M^-1 with M = M_x + M_y = D^T W D.
"""

import math

import numpy as np

from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.reconstruction.normal_matrix import NormalMatrix
from membrane_ctrl.model.arrays import FloatArray

QUANTISATION_VARIANCE_ADU2 = 1 / 12  # of a value rounded to an integer
_POINTS_ACROSS = 15  # of the grid over the mirror
_INSIDE = 0.95  # of the radius


def pixel_sigma_adu(noise_adu: float) -> float:
    """Noise of a pixel with the rounding of its converter."""
    return math.sqrt(noise_adu**2 + QUANTISATION_VARIANCE_ADU2)


def slope_per_screen(geometry: Geometry, radius_mm: float, sag_mm: float) -> FloatArray:
    """How a change of the screen points changes the slopes, as mean squares over the mirror.

    The normal is n = u - d with u the unit vector to the screen point, so d n = (e - u (u e)) / |q|
    d s with e the screen's axis and q the way to the screen, and g = -n_xy / n_z gives d g = -(d
    n_xy + g d n_z) / n_z. It is computed on a bowl of the given sag, each point towards the screen
    point that it really reflects (its normal is then the bowl's own).

    Parameters
    ----------
    geometry : Geometry
        The bench.
    radius_mm, sag_mm : float
        Radius and depth of the bowl.

    Returns
    -------
    (2, 2) array
        Mean of (d g_i / d s_k)^2 in 1/mm^2: rows are the slopes x and y, columns s_x and s_y.
    """
    # Points on the bowl h = sag (r / R)^2, and the normal (-h_x, -h_y, 1) there.
    axis_mm = np.linspace(-0.9, 0.9, _POINTS_ACROSS) * radius_mm
    grid_x, grid_y = np.meshgrid(axis_mm, axis_mm)
    inside = np.hypot(grid_x, grid_y) <= _INSIDE * radius_mm
    x = grid_x[inside]
    y = grid_y[inside]
    height = sag_mm * (x**2 + y**2) / radius_mm**2
    point = np.stack([x, y, height])
    slope_x = 2 * sag_mm * x / radius_mm**2
    slope_y = 2 * sag_mm * y / radius_mm**2
    n = np.stack([-slope_x, -slope_y, np.ones_like(x)])

    # The camera's ray d, its reflection u = d - 2 (d n) / (n n) n, and the way to the screen.
    d = point - geometry.pinhole_mm[:, None]
    d /= np.linalg.norm(d, axis=0)
    d_n = np.sum(d * n, axis=0)
    n_n = np.sum(n * n, axis=0)
    u = d - 2 * d_n / n_n * n
    screen_normal = np.cross(geometry.screen_s_x, geometry.screen_s_y)
    to_origin = geometry.screen_origin_mm[:, None] - point
    reach_mm = (screen_normal @ to_origin) / (screen_normal @ u)

    # Change of the bisector's direction and of its slopes per mm along each of the screen's axes.
    # d u is the part of the axis across the ray over the way; g = -n_xy / n_z.
    bisector = u - d
    negative_slopes = bisector[:2] / bisector[2]
    squares = np.empty((2, 2))
    for k, axis in enumerate((geometry.screen_s_x, geometry.screen_s_y)):
        across = axis[:, None] - u * (axis @ u)
        turn = across / reach_mm
        slope_changes = -(turn[:2] - negative_slopes * turn[2]) / bisector[2]
        squares[:, k] = np.mean(slope_changes**2, axis=1)
    return squares


def parameter_covariance(normal: NormalMatrix, slope_variance: FloatArray) -> FloatArray:
    """Covariance of the fit's parameters from white noise of the slopes.

    Parameters
    ----------
    normal : NormalMatrix
        Of the fit.
    slope_variance : (2,) array
        Variance of the x and of the y slope of a point.

    Returns
    -------
    (parameters, parameters) array
        M^-1 (var_x M_x + var_y M_y) M^-1, in mm^2.
    """
    variance_x, variance_y = slope_variance
    noise = variance_x * normal.x + variance_y * normal.y
    return np.asarray(normal.inverse @ noise @ normal.inverse)
