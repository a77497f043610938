"""Least squares from heights over the unit disc to the terms of a calibration's surface."""

from functools import cache

import numpy as np
from numpy.polynomial import polynomial as series

from membrane_ctrl.metrology.film import hencky_bowl
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.rays import surface_basis
from membrane_ctrl.metrology.rays.surface import PARAMETERS, parameter_to_coeffs
from membrane_ctrl.model.arrays import FloatArray


@cache
def height_projection() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points x and y (n,) of the unit disc, and the matrix (k, n) from heights there to the
    parameters and the terms beyond the fit's.
    """
    k = np.arange(1024)
    rho, theta = np.sqrt((k + 0.5) / k.size), k * np.pi * (3 - np.sqrt(5))
    x, y = rho * np.cos(theta), rho * np.sin(theta)
    excess = series.polyval(rho**2, hencky_bowl.excess_series()) / hencky_bowl.excess_rms()
    own = zernike.evaluate_terms(x, y).T @ parameter_to_coeffs() + np.outer(
        excess, np.eye(PARAMETERS)[-1]
    )
    beyond = surface_basis.evaluate_beyond_basis(x, y)[0].T
    return x, y, np.linalg.pinv(np.hstack([own, beyond]))
