"""Terms beyond those of the fit, which a calibration needs: round ones and waves.

The round ones are three Legendre degrees, a micrometre of a 37 mm bowl. A film's pre-strain changes
them in proportion to its excess.

The waves are what an orthotropic film adds (azimuthal orders 2 and 4), a ring that is not flat or
holds the film unevenly (1 to 5), and their products (up to 10). Their amplitudes fall tenfold from
one radial order to the next. Where the moduli are 12 % apart and the ring is 0.2 mm out of flat,
the largest of them is 0.4 µm, and these terms leave 1 nm.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial import Legendre, Polynomial

from membrane_ctrl.metrology.film import film_law, hencky_bowl
from membrane_ctrl.metrology.film.hencky_bowl import EXCESS_DEGREE, EXCESS_TERMS
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE

# Legendre degrees of the round terms that a calibration does not take from Hencky, of unit RMS
ROUND_DEGREES = (EXCESS_DEGREE + 1, EXCESS_DEGREE + 2, EXCESS_DEGREE + 3)
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


@dataclass(frozen=True)
class Wave:
    """A Zernike term beyond the fit's that is not round."""

    radial_order: int
    azimuthal_order: int  # below 0: a sine
    sigma_mm: float  # of its amplitude in a film that nobody has measured

    @property
    def rms_factor(self) -> float:
        """Height at the rim of the term with unit RMS."""
        return math.sqrt(2 * (self.radial_order + 1))


def _list_waves() -> tuple[Wave, ...]:
    waves = []
    for order, count, sigma_mm in _WAVE_ORDERS:
        first = max(order, ZERNIKE_DEGREE + 1 + (ZERNIKE_DEGREE + 1 - order) % 2)
        for step in range(count):
            known_mm = sigma_mm / _WAVE_FALL**step
            waves.append(Wave(first + 2 * step, order, known_mm))
            waves.append(Wave(first + 2 * step, -order, known_mm))
    return tuple(waves)


WAVES = _list_waves()
ROUND = slice(0, len(ROUND_DEGREES))  # places among the terms beyond the fit's
WAVE = slice(len(ROUND_DEGREES), len(ROUND_DEGREES) + len(WAVES))
BEYOND_TERMS = len(ROUND_DEGREES) + len(WAVES)
WAVE_DEGREE = max(wave.radial_order for wave in WAVES)


@cache
def wave_polynomials() -> FloatArray:
    """Waves of unit RMS (waves, WAVE_DEGREE + 1, WAVE_DEGREE + 1) as polynomials in x and y."""
    rows = [
        wave.rms_factor
        * zernike.radial_polynomial(wave.radial_order, wave.azimuthal_order, WAVE_DEGREE)
        for wave in WAVES
    ]
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
        power = (
            np.sqrt(2 * degree + 1)
            * Legendre.basis(degree, domain=[0, 1]).convert(kind=Polynomial).coef
        )
        row[1 : degree + 1] = power[1:]
    out.setflags(write=False)
    return out


@cache
def _film_family() -> tuple[FloatArray, FloatArray]:
    """`EXCESS_DEGREE` (n,) and `ROUND_DEGREES` (n, 3), unit RMS, of films of unit sag, from a drum
    to the slackest.
    """
    rows = []
    for slackness in np.linspace(1e-3, film_law.SLACKEST, 240):
        bowl = film_law.Bowl(np.asarray(slackness), np.ones(()), hencky_bowl.POISSON_RATIO, 1.0)
        coef = hencky_bowl.legendre_series(bowl, 40).coef.astype(np.float64) / bowl.sag_mm
        rows.append(
            [coef[k] / np.sqrt(2 * k + 1) for k in (hencky_bowl.EXCESS_DEGREE, *ROUND_DEGREES)]
        )
    table = np.array(rows)
    return table[:, 0], table[:, 1:]


def round_of(excess_mm: float, sag_mm: float) -> FloatArray:
    """Terms of `ROUND_DEGREES` (3,) in mm of the film of this law whose excess, of unit RMS, is
    this at this sag.

    At a given sag every film is one number, the slackness, and so is its round figure, whatever
    makes it slack.
    """
    own = (
        hencky_bowl.profile_legendre().coef[[hencky_bowl.EXCESS_DEGREE, *ROUND_DEGREES]]
        / np.sqrt(2 * np.array([hencky_bowl.EXCESS_DEGREE, *ROUND_DEGREES]) + 1)
        / hencky_bowl.excess_rms()
    )
    first, others = _film_family()
    there = [np.interp(excess_mm * own[0] / sag_mm, first, other) for other in others.T]
    return np.asarray(sag_mm * np.array(there) - excess_mm * own[1:])
