"""Hencky's clamped round membrane under uniform pressure, as power series in u = rho^2.

This is the twin's own solution. The reconstruction has another one, so that the two can disagree.
In the scaled form N = q^(2/3) n(rho) with q = p a / (E t):

    n'' + 3 n'/rho + 1/(8 n^2) = 0,   n'(0) = 0,   n'(1) + (1 - nu) n(1) = 0,
    dW/drho = q^(1/3) rho / (2 n).

With n = sum_k b_k u^k and g = 1/n the equation becomes 4 k (k + 1) b_k = -(g^2)_(k-1) / 8, so all
b_k follow from b_0, which the rim's condition fixes. The terms fall by about 0.3 each: 40 of them
reach the last bit.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.optimize import brentq

from membrane_ctrl.model.arrays import FloatArray

_TERMS = 40
POISSON_PET = 0.3


@dataclass(frozen=True, slots=True)
class Hencky:
    """A film's solution, as used by gas and optics.

    Everything but the profile is a number: w0 / (a q^(1/3)) and the volume under the film / (pi a^2
    w0), 0.65344 and
    0.5214 for nu = 0.3. `profile[k]` multiplies u^k: height above the vertex for a sag of 1.
    """

    sag: float
    volume: float
    profile: FloatArray


def _reciprocal_series(series: FloatArray) -> FloatArray:
    """Power series of 1 / series, to the same length."""
    inverse = np.zeros_like(series)
    inverse[0] = 1.0 / series[0]
    for k in range(1, len(series)):
        inverse[k] = -np.dot(series[1 : k + 1], inverse[k - 1 :: -1]) / series[0]
    return inverse


def _force_series(b0: float) -> FloatArray:
    """b_k of the radial force n, given its value at the centre."""
    b = np.zeros(_TERMS)
    b[0] = b0
    for k in range(1, _TERMS):
        g = _reciprocal_series(b[:k])
        b[k] = -np.dot(g, g[::-1]) / (8.0 * 4.0 * k * (k + 1))
    return b


@cache
def solve_hencky(poisson: float = POISSON_PET) -> Hencky:
    """Solve Hencky's equation for a Poisson ratio in [0, 0.5].
    Raises ValueError if it is outside.
    """
    if not 0 <= poisson <= 0.5:
        raise ValueError(f"poisson = {poisson:g} is outside 0 .. 0.5")
    # The series of the radial force is known from b_0; the rim, which does not move, decides b_0.
    k = np.arange(_TERMS)

    def rim_condition(b0: float) -> float:
        return float(np.dot(2.0 * k + 1.0 - poisson, _force_series(b0)))

    b0 = brentq(rim_condition, 0.40, 0.60, xtol=1e-15)

    # The vertical balance gives the slope, 4 dW/du without q^(1/3); its integral is the depth.
    slope = _reciprocal_series(_force_series(b0))
    fall = slope / (k + 1)
    profile = np.concatenate(([0.0], fall)) / fall.sum()
    return Hencky(float(fall.sum()) / 4, float(np.dot(k + 1, profile[1:] / (k + 2))), profile)
