"""Radii and weights with which a fit of slopes over a disc is an integral along the radius."""

import numpy as np
from numpy.polynomial import legendre

from membrane_ctrl.model.arrays import FloatArray

_NODES = 40


def slope_radii(reach: float) -> tuple[FloatArray, FloatArray]:
    """Gauss' nodes along the radius, and the roots of the areas that they stand for."""
    nodes, weights = legendre.leggauss(_NODES)
    rho = reach * (nodes + 1) / 2
    return rho, np.sqrt(weights * rho)
