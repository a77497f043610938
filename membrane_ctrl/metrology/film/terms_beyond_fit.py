"""Terms beyond those of the fit, which a calibration needs: round ones and waves.

The round ones are three Legendre degrees, a micrometre of a 37 mm bowl. A film's pre-strain changes
them in proportion to its excess.

The waves are what an orthotropic film adds (azimuthal orders 2 and 4), a ring that is not flat or
holds the film unevenly (1 to 5), and their products (up to 10). Their amplitudes fall tenfold from
one radial order to the next. Where the moduli are 12 % apart and the ring is 0.2 mm out of flat,
the largest of them is 0.4 µm, and these terms leave 1 nm.
"""

from functools import cache

import numpy as np
from numpy.polynomial import Legendre, Polynomial

from membrane_ctrl.metrology.film import film_law, hencky_bowl
from membrane_ctrl.metrology.film.hencky_bowl import EXCESS_DEGREE, EXCESS_TERMS
from membrane_ctrl.metrology.film.wave_term import Wave, first_radial_order
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model.arrays import FloatArray

# Legendre degrees of the round terms that a calibration does not take from Hencky, of unit RMS
ROUND_DEGREES = (EXCESS_DEGREE + 1, EXCESS_DEGREE + 2, EXCESS_DEGREE + 3)
# The excess' largest degree and these, and sqrt(2 k + 1): coefficient over RMS of degree k.
_FAMILY_DEGREES = np.array([EXCESS_DEGREE, *ROUND_DEGREES])
_FAMILY_RMS = np.sqrt(2 * _FAMILY_DEGREES + 1)
# Azimuthal order of the waves, how many radial orders of each, and 1 sigma of the first of them
_WAVE_ORDERS = (
    (1, 2, 5e-5),
    (2, 3, 5e-4),
    (3, 2, 2e-4),
    (4, 3, 5e-4),
    (5, 2, 2e-4),
    (6, 2, 1e-4),
    (7, 2, 5e-5),
    (8, 2, 5e-5),
    (9, 2, 5e-5),
    (10, 2, 5e-5),
)
_WAVE_FALL = 5.0  # from one radial order to the next; a film of the law has ten
# Films between which the round terms are interpolated: their number, the slackness of the first,
# and the degree of their Legendre series.
_FAMILY_FILMS = 240
_TAUTEST = 1e-3
_FAMILY_DEGREE = 40

WAVES = tuple(
    Wave(first_radial_order(order) + 2 * step, sign * order, sigma_mm / _WAVE_FALL**step)
    for order, count, sigma_mm in _WAVE_ORDERS
    for step in range(count)
    for sign in (1, -1)
)
ROUND = slice(0, len(ROUND_DEGREES))  # places among the terms beyond the fit's
WAVE = slice(len(ROUND_DEGREES), len(ROUND_DEGREES) + len(WAVES))
BEYOND_TERMS = len(ROUND_DEGREES) + len(WAVES)
WAVE_DEGREE = max(wave.radial_order for wave in WAVES)


@cache
def wave_polynomials() -> FloatArray:
    """Waves of unit RMS (waves, WAVE_DEGREE + 1, WAVE_DEGREE + 1) as polynomials in x and y."""
    rows = []
    for wave in WAVES:
        polynomial = zernike.radial_polynomial(wave.radial_order, wave.azimuthal_order, WAVE_DEGREE)
        rows.append(wave.rms_factor * polynomial)
    out = np.stack(rows)
    out.setflags(write=False)
    return out


@cache
def round_series() -> FloatArray:
    """Power series in v, (ROUND_DEGREES, EXCESS_TERMS), of the round terms beyond the fit's, each 0
    at the vertex.
    """
    out = np.zeros((len(ROUND_DEGREES), EXCESS_TERMS))
    for row, degree in zip(out, ROUND_DEGREES, strict=True):
        powers = Legendre.basis(degree, domain=[0, 1]).convert(kind=Polynomial).coef
        row[1 : degree + 1] = np.sqrt(2 * degree + 1) * powers[1:]
    out.setflags(write=False)
    return out


@cache
def _film_family() -> tuple[FloatArray, FloatArray]:
    """`EXCESS_DEGREE` (n,) and `ROUND_DEGREES` (n, 3), unit RMS, of films of unit sag, from a drum
    to the slackest.
    """
    rows = []
    for slackness in np.linspace(_TAUTEST, film_law.SLACKEST, _FAMILY_FILMS):
        bowl = film_law.Bowl(np.asarray(slackness), np.ones(()), hencky_bowl.POISSON_RATIO, 1.0)
        legendre_series = hencky_bowl.legendre_series(bowl, _FAMILY_DEGREE)
        of_unit_sag = legendre_series.coef.astype(np.float64) / bowl.sag_mm
        rows.append(of_unit_sag[_FAMILY_DEGREES] / _FAMILY_RMS)
    table = np.array(rows)
    return table[:, 0], table[:, 1:]


def film_round_terms_mm(excess_mm: float, sag_mm: float) -> FloatArray:
    """Round terms beyond the fit's of a film of this law, from its excess.

    At a given sag every film is one number, the slackness, and so is its round figure, whatever
    makes it slack.

    Parameters
    ----------
    excess_mm : float
        Amplitude of the excess of unit RMS.
    sag_mm : float
        Sag of the film.

    Returns
    -------
    (3,) array
        Terms of `ROUND_DEGREES`, mm.
    """
    # The same degrees of the excess of unit RMS.
    coef = hencky_bowl.profile_legendre().coef[_FAMILY_DEGREES]
    of_excess = coef / _FAMILY_RMS / hencky_bowl.excess_rms()

    # The film of the family with this share of the first degree, less what the excess has itself.
    first, others = _film_family()
    share = excess_mm * of_excess[0] / sag_mm
    of_film = [np.interp(share, first, other) for other in others.T]
    return np.asarray(sag_mm * np.array(of_film) - excess_mm * of_excess[1:])
