"""Hencky's bowl: the law of the film without pre-strain, as a polynomial in v = (r / a)^2.

Over the unit disc the rotationally symmetric Zernike terms are sqrt(2k + 1) P_k(2v - 1) with
Legendre's P_k, so the Legendre series of the profile *is* its Zernike expansion: P_0, P_1, P_2,
... are Noll 1, 4, 11, ... What lies above the degree of the fit is the "excess", with 36 terms
some micrometres of a 37 mm bowl.
"""

from functools import cache

import numpy as np
from numpy.polynomial import Chebyshev, Legendre, Polynomial

from membrane_ctrl.metrology.film.film_law import Bowl, FilmLaw
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE, ZERNIKE_TERMS

POISSON_RATIO = 0.3
# Legendre degree 14; the coefficients fall sevenfold a degree: what is cut off is below 1e-13 of
# the sag
EXCESS_TERMS = 15
# Noll indices of the round terms that the fit has, by Legendre degree: the first of order n = 2k
# has (n^2 + n) / 2 terms before it, and its m = 0
ROUND_NOLL = tuple(k * (2 * k + 1) + 1 for k in range(ZERNIKE_DEGREE // 2 + 1))
EXCESS_DEGREE = len(ROUND_NOLL)  # Legendre degree of the excess' largest part


@cache
def profile_legendre() -> Legendre:
    """Depth H(v) of a bowl of unit sag, 0 at the vertex and 1 at the rim, as Legendre series on v
    in [0, 1].
    """
    bowl = FilmLaw(0.0, POISSON_RATIO, 1.0, 1.0).with_sag(1.0)
    return legendre_series(bowl, EXCESS_TERMS + 8).truncate(EXCESS_TERMS)


def legendre_series(bowl: Bowl, degree: int) -> Legendre:
    """Return a bowl's depth as a series on v = (r / R)^2.

    Parameters
    ----------
    bowl : Bowl
    degree : int
        Degree of the Chebyshev interpolation from which it is converted.

    Returns
    -------
    Legendre
        In mm, on v in [0, 1].
    """
    depth = Chebyshev.interpolate(lambda v: bowl.height_mm(np.sqrt(v)), degree, domain=[0, 1])
    return depth.convert(domain=[0, 1], kind=Legendre)


@cache
def zernike_projection() -> FloatArray:
    """Noll coefficients (terms,) of a Hencky bowl of unit sag;
    also their change per unit of sag.
    """
    out = np.zeros(ZERNIKE_TERMS)
    for degree, j in enumerate(ROUND_NOLL):
        out[j - 1] = profile_legendre().coef[degree] / np.sqrt(2 * degree + 1)
    out.setflags(write=False)
    return out


@cache
def excess_series() -> FloatArray:
    """Power series in v of the part of a bowl of unit sag that the terms cannot represent."""
    coef = profile_legendre().coef.copy()
    coef[:EXCESS_DEGREE] = 0.0
    out = Legendre(coef, domain=[0, 1]).convert(kind=Polynomial).coef
    out.setflags(write=False)
    return np.asarray(out)


@cache
def excess_rms() -> float:
    """RMS over the disc of the excess of a bowl of unit sag."""
    coef: FloatArray = np.asarray(profile_legendre().coef).astype(np.float64)
    squares = coef**2 / (2 * np.arange(EXCESS_TERMS) + 1)
    return float(np.sqrt(np.sum(squares[EXCESS_DEGREE:])))


def bowl_profile(rho: FloatArray) -> FloatArray:
    """Depth of a bowl of unit sag at rho = r / R, an array of any shape: 0 at the vertex, 1 at the
    rim.
    """
    return np.asarray(profile_legendre()(np.square(rho)))
