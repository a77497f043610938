"""Harmonics of the height of the surface's rim."""

from functools import cache

import numpy as np

from membrane_ctrl.metrology.rays import surface_basis
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE

RING = (
    2 * ZERNIKE_DEGREE + 1
)  # harmonics of the rim: a constant, cosines and sines up to the degree


@cache
def rim_harmonics() -> FloatArray:
    """Matrix (RING, parameters) from a surface to the harmonics of its rim's height above the
    vertex.
    """
    theta = 2 * np.pi * np.arange(4 * RING) / (4 * RING)
    heights = surface_basis.evaluate_basis(np.cos(theta), np.sin(theta))[0]
    orders = np.outer(np.arange(1, ZERNIKE_DEGREE + 1), theta)
    waves = np.vstack([np.full((1, theta.size), 0.5), np.cos(orders), np.sin(orders)])
    return np.asarray(waves @ heights.T * 2 / theta.size)
