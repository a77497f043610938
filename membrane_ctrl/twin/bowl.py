"""Profile of the bowl as a power series in rho^2: quick and exact inside a ray tracer.

Hencky's problem (a clamped membrane under uniform pressure) in the scaled form N = q^(2/3) n(rho):

    n'' + 3 n'/rho + 1/(8 n^2) = 0,   n'(0) = 0,   n'(1) + (1 - nu) n(1) = 0,   dW/drho ~ rho / n.

With n = sum_k b_k rho^(2k) and g = 1/n the equation reads 4 k (k + 1) b_k = -(g^2)_(k-1) / 8, so that all b_k follow
from b_0, which the rim's condition fixes. The terms fall by about 0.3 each: 40 of them reach the last bit.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

_TERMS = 40
_POISSON = 0.3  # PET


def _reciprocal(series: NDArray[np.float64]) -> NDArray[np.float64]:
    """Power series of 1 / series, to the same length."""
    inverse = np.zeros_like(series)
    inverse[0] = 1.0 / series[0]
    for k in range(1, len(series)):
        inverse[k] = -np.dot(series[1 : k + 1], inverse[k - 1 :: -1]) / series[0]
    return inverse


def _force_series(b0: float) -> NDArray[np.float64]:
    """b_k of the radial force n, given its value at the centre."""
    b = np.zeros(_TERMS)
    b[0] = b0
    for k in range(1, _TERMS):
        g = _reciprocal(b[:k])
        b[k] = -np.dot(g, g[::-1]) / (8.0 * 4.0 * k * (k + 1))
    return b


@cache
def _hencky_terms() -> tuple[float, ...]:
    def rim_condition(b0: float) -> float:
        b = _force_series(b0)
        return float(np.dot(2.0 * np.arange(_TERMS) + 1.0 - _POISSON, b))

    # n(0) = 0.431 for nu = 0.3; below 0.40 the rim's condition has no root
    b = _force_series(brentq(rim_condition, 0.40, 0.60, xtol=1e-15))
    slope = _reciprocal(b)  # dW/d(rho^2), unscaled
    profile = np.concatenate(([0.0], slope / np.arange(1, _TERMS + 1)))
    return tuple(profile / profile.sum())


def hencky_series() -> NDArray[np.float64]:
    """Height of a Hencky bowl of unit sag above its vertex: element k multiplies rho^(2k); nu = 0.3."""
    return np.array(_hencky_terms())


def paraboloid_series() -> NDArray[np.float64]:
    """Height of a paraboloid of unit sag: rho^2."""
    return np.array([0.0, 1.0])
