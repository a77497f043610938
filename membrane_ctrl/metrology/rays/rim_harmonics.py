"""Harmonics of the height of the surface's rim."""

from functools import cache

import numpy as np

from membrane_ctrl.metrology.rays import surface_basis
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE

# Harmonics of the rim: a constant, cosines and sines up to the degree.
RING = 2 * ZERNIKE_DEGREE + 1


@cache
def rim_harmonics() -> FloatArray:
    """Matrix (RING, parameters) from a surface to the harmonics of its rim's height above the
    vertex.
    """
    # Height of each parameter's term at points of the rim.
    count = 4 * RING
    theta = 2 * np.pi * np.arange(count) / count
    heights = surface_basis.evaluate_basis(np.cos(theta), np.sin(theta))[0]

    # Fourier series over these points: 2 / count times the sum of height times wave; half of it for
    # the constant.
    angles = np.outer(np.arange(1, ZERNIKE_DEGREE + 1), theta)
    half = np.full((1, count), 0.5)
    waves = np.vstack([half, np.cos(angles), np.sin(angles)])
    return np.asarray(waves @ heights.T * 2 / count)
