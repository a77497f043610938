"""Round terms beyond those of the fit, which a calibration needs: three Legendre degrees.

They are a micrometre of a 37 mm bowl. A film's pre-strain changes them in proportion to its
excess.
"""

from functools import cache

import numpy as np
from numpy.polynomial import Legendre, Polynomial

from membrane_ctrl.metrology.film import film_law, hencky_bowl, terms_beyond_fit
from membrane_ctrl.metrology.film.hencky_bowl import EXCESS_DEGREE, EXCESS_TERMS
from membrane_ctrl.model.arrays import FloatArray

# Round terms beyond the fit's that a calibration does not take from Hencky: three Legendre degrees,
# of unit RMS
BEYOND = (EXCESS_DEGREE + 1, EXCESS_DEGREE + 2, EXCESS_DEGREE + 3)


@cache
def beyond_series() -> FloatArray:
    """Power series in v, (len(BEYOND), EXCESS_TERMS), of the round terms beyond the fit's, each 0
    at the vertex.
    """
    out = np.zeros((len(BEYOND), EXCESS_TERMS))
    for row, degree in zip(out, BEYOND, strict=True):
        power = (
            np.sqrt(2 * degree + 1)
            * Legendre.basis(degree, domain=[0, 1]).convert(kind=Polynomial).coef
        )
        row[1 : degree + 1] = power[1:]
    out.setflags(write=False)
    return out


@cache
def _film_family() -> tuple[FloatArray, FloatArray]:
    """`EXCESS_DEGREE` (n,) and `BEYOND` (n, 3), unit RMS, of films of unit sag, from a drum to the
    slackest.
    """
    rows = []
    for slackness in np.linspace(1e-3, film_law.SLACKEST, 240):
        bowl = film_law.Bowl(np.asarray(slackness), np.ones(()), hencky_bowl.POISSON_RATIO, 1.0)
        coef = hencky_bowl.legendre_series(bowl, 40).coef.astype(np.float64) / bowl.sag_mm
        rows.append(
            [
                coef[k] / np.sqrt(2 * k + 1)
                for k in (hencky_bowl.EXCESS_DEGREE, *terms_beyond_fit.BEYOND)
            ]
        )
    table = np.array(rows)
    return table[:, 0], table[:, 1:]


def beyond_of(excess_mm: float, sag_mm: float) -> FloatArray:
    """Terms of `BEYOND` (3,) in mm of the film of this law whose excess, of unit RMS, is this at
    this sag.

    At a given sag every film is one number, the slackness, and so is its round figure, whatever
    makes it slack.
    """
    own = (
        hencky_bowl.profile_legendre().coef[[hencky_bowl.EXCESS_DEGREE, *terms_beyond_fit.BEYOND]]
        / np.sqrt(2 * np.array([hencky_bowl.EXCESS_DEGREE, *terms_beyond_fit.BEYOND]) + 1)
        / hencky_bowl.excess_rms()
    )
    first, others = _film_family()
    there = [np.interp(excess_mm * own[0] / sag_mm, first, other) for other in others.T]
    return np.asarray(sag_mm * np.array(there) - excess_mm * own[1:])
