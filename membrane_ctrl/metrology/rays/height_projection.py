"""Least squares from heights over the unit disc to the terms of a calibration's surface."""

from functools import cache

import numpy as np
from numpy.polynomial import polynomial as series

from membrane_ctrl.metrology.film import hencky_bowl
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.rays import surface_basis
from membrane_ctrl.metrology.rays.surface import PARAMETERS, parameter_to_coeffs
from membrane_ctrl.model.arrays import FloatArray

_POINTS = 1024  # of the disc


@cache
def height_projection() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points x and y (n,) of the unit disc, and the matrix (k, n) from heights there to the
    parameters and the terms beyond the fit's.
    """
    # Points spread evenly over the disc: a sunflower, whose angle grows by the golden one.
    k = np.arange(_POINTS)
    rho = np.sqrt((k + 0.5) / _POINTS)
    theta = k * np.pi * (3 - np.sqrt(5))
    x = rho * np.cos(theta)
    y = rho * np.sin(theta)

    # Heights (points, columns) of each parameter, the excess being the last, and of each term
    # beyond the fit's.
    excess = series.polyval(rho**2, hencky_bowl.excess_series()) / hencky_bowl.excess_rms()
    by_excess = np.outer(excess, np.eye(PARAMETERS)[-1])
    by_parameters = zernike.evaluate_terms(x, y).T @ parameter_to_coeffs() + by_excess
    by_beyond = surface_basis.evaluate_beyond_basis(x, y)[0].T
    return x, y, np.linalg.pinv(np.hstack([by_parameters, by_beyond]))
