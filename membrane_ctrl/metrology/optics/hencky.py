"""The Hencky bowl: the film's law (`film_law`) without pre-strain, as a polynomial in v = (r / R)^2.

Over the unit disc the rotationally symmetric Zernike terms are sqrt(2k + 1) P_k(2v - 1) with Legendre's P_k, so the
Legendre series of the profile *is* its Zernike expansion. P_0..P_3 are Noll 1, 4, 11 and 22 and among the 36 terms;
the rest is the "excess", some micrometres of a 37 mm bowl.
"""

from functools import cache

import numpy as np
from numpy.polynomial import Chebyshev, Legendre, Polynomial

from membrane_ctrl.metrology.optics.film_law import FilmLaw
from membrane_ctrl.metrology.optics.zernike import TERMS
from membrane_ctrl.model.arrays import FloatArray

POISSON_RATIO = 0.3
# Legendre degree 14; the coefficients fall sevenfold a degree: what is cut off is below 1e-13 of the sag
EXCESS_TERMS = 15
_CARRIED = {0: 1, 1: 4, 2: 11, 3: 22}  # Legendre degree -> Noll index


@cache
def profile_legendre() -> Legendre:
    """Depth H(v) of a bowl of unit sag, 0 at the vertex and 1 at the rim, as Legendre series on v in [0, 1]."""
    bowl = FilmLaw(0.0, POISSON_RATIO, 1.0, 1.0).with_sag(1.0)
    depth = Chebyshev.interpolate(lambda v: bowl.height_mm(np.sqrt(v)), EXCESS_TERMS + 8, domain=[0, 1])
    return depth.convert(domain=[0, 1], kind=Legendre).truncate(EXCESS_TERMS)


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
