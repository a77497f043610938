"""Elastic constants of an orthotropic film from what its figures show.

The round figure gives the means over all directions, E and nu; the two waves U2 and the four waves
U3 of the stiffness (Tsai and Pagano) give what differs (`film_law`). In units of E t

    Q11 = U1 + U2 + U3,  Q22 = U1 - U2 + U3,  Q12 = U4 - U3,  Q66 = (U1 - U4) / 2 - U3

along the stiff direction, with U1 = 1 / (1 - nu^2), U4 = nu U1; then

    nu12 = Q12 / Q22,  E1 t = Q11 - Q12^2 / Q22,  E2 t = Q22 - Q12^2 / Q11,  G12 t = Q66.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.film.film_law import FilmLaw
from membrane_ctrl.metrology.film.ring_waves import SURE_SIGMAS, RingWave
from membrane_ctrl.model.arrays import FloatArray

_STEP = 1e-6  # of the numerical derivatives; all inputs are of order 1 or smaller
CONSTANTS = ("e1_n_per_m", "e2_n_per_m", "g12_n_per_m", "nu12", "ratio", "g12_over_e1")


@dataclass(frozen=True)
class OrthotropicFilm:
    """Elastic constants times the thickness.

    Attributes
    ----------
    values : (6,) array
        By `CONSTANTS`: E1 t, E2 t and G12 t in N/m, Poisson ratio nu12, E1 / E2, G12 / E1. Those in
        N/m have no meaning without pressures.
    covariance : (6, 6) array
    direction_rad, direction_sigma_rad : float
        Angle from x to the stiff direction, 0 to pi; with equal moduli and a soft shear, to the
        first of the two stiff directions. NaN if none is seen.
    has_other_axes : bool
        Whether the four waves contradict the axes of the two: no orthotropic film has that.
    """

    values: FloatArray
    covariance: FloatArray
    direction_rad: float
    direction_sigma_rad: float
    has_other_axes: bool

    @property
    def sigmas(self) -> FloatArray:
        """Standard uncertainties of `values`."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def has_direction(self) -> bool:
        """Whether a stiff direction is seen."""
        return bool(np.isfinite(self.direction_rad))


def find_orthotropy(
    law: FilmLaw, covariance: FloatArray, waves: tuple[RingWave, ...]
) -> OrthotropicFilm | None:
    """Return the elastic constants; None if the waves of a film's orders have another cause.

    Parameters
    ----------
    law : FilmLaw
        The means over all directions.
    covariance : (3, 3) array
        Of pre-strain, Poisson ratio and relative stiffness.
    waves : tuple of RingWave
        All causes of waves.
    """
    # Each of the film's causes belongs to one order of waves
    by_cause = {wave.cause: wave for wave in waves}
    moduli, shear = by_cause["modulus"], by_cause["shear"]
    if not (moduli.explained and shear.explained):
        return None
    # 1. The stiff direction: half the phase of the two waves
    cosine, sine = moduli.amounts
    apart = float(np.hypot(cosine, sine))
    apart_sigma = float(np.max(moduli.sigmas))
    seen = apart > SURE_SIGMAS * apart_sigma
    direction_rad = direction_sigma_rad = np.nan
    if seen:
        direction_rad = float(np.arctan2(sine, cosine)) / 2 % np.pi
        direction_sigma_rad = apart_sigma / apart / 2
    # 2. The four waves along the same axes. Equal moduli have two pairs of axes, 45 degrees apart,
    # with opposite signs of the four waves: those of the larger modulus, where the shear is soft
    four_cosine, four_sine = shear.amounts
    shear_sigma = float(np.max(shear.sigmas))
    size = float(np.hypot(four_cosine, four_sine))
    along = across = 0.0
    if seen:
        angle = 4 * direction_rad
        along = float(four_cosine * np.cos(angle) + four_sine * np.sin(angle))
        across = float(four_sine * np.cos(angle) - four_cosine * np.sin(angle))
    elif size > SURE_SIGMAS * shear_sigma:
        along = -size
        direction_rad = float(np.arctan2(-four_sine, -four_cosine)) / 4 % (np.pi / 2)
        direction_sigma_rad = shear_sigma / size / 4
    else:
        shear_sigma = float(np.hypot(shear_sigma, size))
    # 3. The constants and their covariance
    inputs = np.array([law.poisson, np.log(law.stiffness_n_per_m), apart, along], dtype=float)
    spread = np.zeros((4, 4))
    spread[:2, :2] = covariance[1:, 1:]
    spread[2, 2], spread[3, 3] = apart_sigma**2, shear_sigma**2
    slopes = np.stack(
        [
            (_find_constants(inputs + step) - _find_constants(inputs - step)) / (2 * _STEP)
            for step in _STEP * np.eye(4)
        ],
        axis=1,
    )
    return OrthotropicFilm(
        values=_find_constants(inputs),
        covariance=slopes @ spread @ slopes.T,
        direction_rad=direction_rad,
        direction_sigma_rad=direction_sigma_rad,
        has_other_axes=abs(across) > SURE_SIGMAS * shear_sigma,
    )


def _find_constants(inputs: FloatArray) -> FloatArray:
    """`CONSTANTS` from nu, the logarithm of E t, and the amounts of moduli and shear."""
    nu, log_stiffness, apart, shear = inputs
    stiffness = np.exp(log_stiffness)
    u1 = 1 / (1 - nu**2)
    u4 = nu * u1
    # `Bowl.harmonic` states both by one unit of their cause
    u2 = 0.5 * u1 * apart
    u3 = -0.25 / (1 + nu) * shear
    q11, q22 = u1 + u2 + u3, u1 - u2 + u3
    q12, q66 = u4 - u3, (u1 - u4) / 2 - u3
    e1, e2 = q11 - q12**2 / q22, q22 - q12**2 / q11
    return np.array([e1 * stiffness, e2 * stiffness, q66 * stiffness, q12 / q22, e1 / e2, q66 / e1])
