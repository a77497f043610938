"""The Hencky bowl: a flat film under uniform pressure, clamped at its rim, as a polynomial in v = (r / R)^2.

The stress n(rho) obeys n'' + 3 n'/rho + 1/(8 n^2) = 0 with n'(0) = 0 and n'(1) + (1 - nu) n(1) = 0; the slope of the
film is proportional to rho / n. In v the equation is 4 v n_vv + 8 n_v + 1/(8 n^2) = 0: with n = sum b_k v^k and
n^-2 = sum c_k v^k it gives b_{k+1} = -c_k / (32 (k + 1) (k + 2)), and the depth is the integral of dv / n.

Over the unit disc the rotationally symmetric Zernike terms are sqrt(2k + 1) P_k(2v - 1) with Legendre's P_k, so the
Legendre series of the profile *is* its Zernike expansion. P_0..P_3 are Noll 1, 4, 11 and 22 and among the 36 terms;
the rest is the "excess", some micrometres of a 37 mm bowl.

Source: H. Hencky, Z. Math. Phys. 63, 311 (1915); W. B. Fichter, NASA TP-3658 (1997).
"""

from functools import cache

import numpy as np
from numpy.polynomial import Chebyshev, Legendre, Polynomial

from membrane_ctrl.metrology.optics.zernike import TERMS
from membrane_ctrl.model.arrays import FloatArray

POISSON_RATIO = 0.3
_SERIES_TERMS = 80  # the nearest singularity is beyond v = 2: the last term is below 1e-24
# Legendre degree 14; the coefficients fall sevenfold a degree: what is cut off is below 1e-13 of the sag
EXCESS_TERMS = 15
_CARRIED = {0: 1, 1: 4, 2: 11, 3: 22}  # Legendre degree -> Noll index


def stress_series(centre: float) -> FloatArray:
    """Power series in v of the stress n with the given value at the centre."""
    b = np.zeros(_SERIES_TERMS)
    c = np.zeros(_SERIES_TERMS)  # of n^-2, by the recurrence for powers of a series
    b[0], c[0] = centre, centre**-2
    for k in range(_SERIES_TERMS - 1):
        b[k + 1] = -c[k] / (32 * (k + 1) * (k + 2))
        m = np.arange(1, k + 2)
        c[k + 1] = np.sum((-2 * m - (k + 1) + m) * b[m] * c[k + 1 - m]) / ((k + 1) * centre)
    return b


@cache
def stress(poisson_ratio: float = POISSON_RATIO) -> Polynomial:
    """The stress n(v) that satisfies the rim's condition."""

    from scipy.optimize import brentq  # imports for half a second, for one number

    def rim(centre: float) -> float:
        b = stress_series(centre)
        return float(np.sum((2 * np.arange(_SERIES_TERMS) + 1 - poisson_ratio) * b))

    return Polynomial(stress_series(brentq(rim, 0.36, 1.0, xtol=1e-15)))


@cache
def profile_legendre() -> Legendre:
    """Depth H(v) of a bowl of unit sag, 0 at the vertex and 1 at the rim, as Legendre series on v in [0, 1]."""
    n = stress()
    slope = Chebyshev.interpolate(lambda v: 1 / n(v), EXCESS_TERMS + 8, domain=[0, 1])
    depth = slope.convert(domain=[0, 1], kind=Legendre).integ(lbnd=0)
    return (depth / depth(1.0)).truncate(EXCESS_TERMS)


@cache
def zernike_projection() -> FloatArray:
    """Noll coefficients (36,) of a Hencky bowl of unit sag; also their change per unit of sag."""
    out = np.zeros(TERMS)
    for degree, j in _CARRIED.items():
        out[j - 1] = profile_legendre().coef[degree] / np.sqrt(2 * degree + 1)
    out.setflags(write=False)
    return out


@cache
def excess() -> FloatArray:
    """Power series in v of the part of a bowl of unit sag that the 36 terms cannot represent."""
    coef = profile_legendre().coef.copy()
    coef[list(_CARRIED)] = 0.0
    out = Legendre(coef, domain=[0, 1]).convert(kind=Polynomial).coef
    out.setflags(write=False)
    return np.asarray(out)


@cache
def excess_rms() -> float:
    """RMS over the disc of the excess of a bowl of unit sag."""
    coef: FloatArray = np.asarray(profile_legendre().coef).astype(np.float64)
    squares = coef**2 / (2 * np.arange(EXCESS_TERMS) + 1)
    return float(np.sqrt(np.sum(np.delete(squares, list(_CARRIED)))))


def profile(rho: FloatArray) -> FloatArray:
    """Depth of a bowl of unit sag at rho = r / R, 0 at the vertex and 1 at the rim."""
    return np.asarray(profile_legendre()(np.square(rho)))
