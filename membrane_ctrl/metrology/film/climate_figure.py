"""How the figure of a film changes when the film becomes longer than its ring.

Temperature and humidity strain film and ring. An even strain of the film above that of the ring,
the excess strain e, acts as a pre-strain of -e (`film_law`), whatever caused it. With the vertex
held, i.e. at equal sag, the height changes by

    dh(rho) = e dh/de,       dh/de = -d/d(prestrain) of the film's height above the vertex

The derivative is taken of the law at the held sag. An uneven strain (a lamp, a hand, the sun) is
not in this model.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from membrane_ctrl.metrology.film.film_law import FilmLaw
from membrane_ctrl.metrology.film.hencky_bowl import ROUND_NOLL, legendre_series
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

# Mylar of the maker (bulletin H-37232-3)
PET_POISSON_RATIO = 0.38
# Step of the derivative: the strain of a hundredth of a kelvin, and five digits of the difference
_STEP = 1e-6
_DEGREE = 20


@dataclass(frozen=True)
class ClimateSensitivity:
    """Change of the mirror for an excess strain of the film of 1e-6.

    Attributes
    ----------
    terms_um : (terms,) array
        Noll coefficients of the change of height at equal sag, in µm; the vertex stays.
    figure_rms_um : float
        RMS of that change over the whole mirror without its mean and its focus.
    change_rms_um : float
        RMS of that change over the whole mirror.
    centre_um : float
        Rise of the centre at equal pressure, in µm.
    """

    terms_um: FloatArray
    figure_rms_um: float
    change_rms_um: float
    centre_um: float


@cache
def compute_climate_sensitivity(
    radius_mm: float, sag_mm: float, poisson: float = PET_POISSON_RATIO
) -> ClimateSensitivity:
    """Compute the change of a film without pre-strain, from the law of the film.

    Parameters
    ----------
    radius_mm, sag_mm : float
        Of the mirror.
    poisson : float
        Poisson ratio of the film.

    Returns
    -------
    ClimateSensitivity
    """
    longer, shorter = (FilmLaw(e, poisson, 1.0, radius_mm) for e in (-_STEP, _STEP))
    per_step = 1e-6 / (2 * _STEP)
    # At equal sag: the height above the vertex as a series of Legendre, i.e. round Zernike terms
    difference = legendre_series(longer.with_sag(sag_mm), _DEGREE) - legendre_series(
        shorter.with_sag(sag_mm), _DEGREE
    )
    coefficients: FloatArray = np.asarray(difference.coef, dtype=np.float64)
    change: FloatArray = 1e3 * per_step * coefficients
    terms_um = np.zeros(ZERNIKE_TERMS)
    for degree, noll in enumerate(ROUND_NOLL):
        terms_um[noll - 1] = change[degree] / np.sqrt(2 * degree + 1)
    terms_um.setflags(write=False)
    # Mean squares over the disc, dv = 2 rho drho: each Legendre polynomial has 1 / (2k + 1)
    squares = change**2 / (2 * np.arange(change.size) + 1)
    # At equal pressure: dh/de at the rim
    load = FilmLaw(0.0, poisson, 1.0, radius_mm).with_sag(sag_mm).load
    rise_mm = longer.under_load(load).sag_mm - shorter.under_load(load).sag_mm
    return ClimateSensitivity(
        terms_um=terms_um,
        figure_rms_um=float(np.sqrt(squares[2:].sum())),
        change_rms_um=float(np.sqrt(squares.sum())),
        centre_um=float(1e3 * per_step * rise_mm),
    )
