"""Elastic constants of an orthotropic film from what its figures show.

A film of thickness t has four constants along its axes: E1 and E2 (stiff and soft direction), the
shear modulus G12, and the Poisson ratio nu12. Turned by an angle theta against its axes, its
stiffness is a mean over all directions, a part that goes with cos 2 theta, and one with cos 4 theta
(the invariants U1 to U4 of Tsai and Pagano). Each part shows in another part of the figure:

- the round bowl shows the means, as an isotropic film's E t and nu:

      U1 = 1 / (1 - nu^2),   U4 = nu U1                                         in units of E t  (1)

- its two waves show U2, by the moduli's difference d = (E1 - E2) / mean; its four waves show U3, by
  the share s by which the shear modulus exceeds that of an isotropic film (`Bowl.harmonic`):

      U2 = U1 d / 2,   U3 = -s / (4 (1 + nu))                                                    (2)

Along the axes the stiffness is then

      Q11 = U1 + U2 + U3,   Q22 = U1 - U2 + U3,   Q12 = U4 - U3,   Q66 = (U1 - U4) / 2 - U3      (3)

and the constants are

      nu12 = Q12 / Q22,   E1 t = Q11 - Q12^2 / Q22,   E2 t = Q22 - Q12^2 / Q11,   G12 t = Q66.   (4)
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
    moduli = by_cause["modulus"]
    shear = by_cause["shear"]
    if not (moduli.explained and shear.explained):
        return None
    axes = _find_axes(moduli, shear)

    # nu, ln(E t), d and s, and their covariance: the round figure and the waves are independent
    inputs = np.array([law.poisson, np.log(law.stiffness_n_per_m), axes.difference, axes.shear])
    spread = np.zeros((4, 4))
    spread[:2, :2] = covariance[1:, 1:]
    spread[2, 2] = axes.difference_sigma**2
    spread[3, 3] = axes.shear_sigma**2

    # The constants, and their covariance by the derivatives J of (1) to (4): J S J'
    columns = []
    for step in _STEP * np.eye(inputs.size):
        change = _find_constants(inputs + step) - _find_constants(inputs - step)
        columns.append(change / (2 * _STEP))
    derivatives = np.stack(columns, axis=1)
    return OrthotropicFilm(
        values=_find_constants(inputs),
        covariance=derivatives @ spread @ derivatives.T,
        direction_rad=axes.direction_rad,
        direction_sigma_rad=axes.direction_sigma_rad,
        has_other_axes=abs(axes.across) > SURE_SIGMAS * axes.shear_sigma,
    )


@dataclass(frozen=True)
class _Axes:
    """The film's axes, and the amounts of its waves along them.

    Attributes
    ----------
    direction_rad, direction_sigma_rad : float
        Of the stiff direction; NaN if none is seen.
    difference, difference_sigma : float
        d of (2).
    shear, shear_sigma : float
        s of (2).
    across : float
        Four waves that do not lie along the axes: 0 for an orthotropic film.
    """

    direction_rad: float
    direction_sigma_rad: float
    difference: float
    difference_sigma: float
    shear: float
    shear_sigma: float
    across: float


def _find_axes(moduli: RingWave, shear: RingWave) -> _Axes:
    """The axes by the two waves of the moduli, else by the four waves of the shear."""
    difference = float(np.hypot(*moduli.amounts))
    difference_sigma = float(np.max(moduli.sigmas))
    shear_size = float(np.hypot(*shear.amounts))
    shear_sigma = float(np.max(shear.sigmas))

    # The moduli differ: two waves cos 2 (theta - direction), whose phase is twice the direction.
    # The four waves are split into the part along the same axes and the part across.
    if moduli.is_sure:
        direction_rad = _find_phase(moduli) / 2 % np.pi
        turn = 4 * direction_rad
        cosine, sine = shear.amounts
        return _Axes(
            direction_rad,
            difference_sigma / difference / 2,
            difference,
            difference_sigma,
            shear=float(cosine * np.cos(turn) + sine * np.sin(turn)),
            shear_sigma=shear_sigma,
            across=float(sine * np.cos(turn) - cosine * np.sin(turn)),
        )

    # Equal moduli, another shear: two pairs of axes, 45 degrees apart, with opposite signs of s.
    # Those of the larger modulus are taken, along which the shear is soft (s below 0).
    if shear.is_sure:
        direction_rad = (_find_phase(shear) + np.pi) / 4 % (np.pi / 2)
        return _Axes(
            direction_rad,
            shear_sigma / shear_size / 4,
            difference,
            difference_sigma,
            shear=-shear_size,
            shear_sigma=shear_sigma,
            across=0.0,
        )

    # No direction: the shear is that of an isotropic film to what is seen and its error
    widened = float(np.hypot(shear_sigma, shear_size))
    return _Axes(np.nan, np.nan, difference, difference_sigma, 0.0, widened, 0.0)


def _find_phase(wave: RingWave) -> float:
    """Phase of A cos(m theta) + B sin(m theta), rad."""
    cosine, sine = wave.amounts
    return float(np.arctan2(sine, cosine))


def _find_constants(inputs: FloatArray) -> FloatArray:
    """`CONSTANTS` from nu, ln(E t), d and s, by (1) to (4)."""
    poisson, log_stiffness, difference, shear = inputs
    stiffness = np.exp(log_stiffness)
    # (1) and (2)
    u1 = 1 / (1 - poisson**2)
    u4 = poisson * u1
    u2 = u1 * difference / 2
    u3 = -shear / (4 * (1 + poisson))
    # (3)
    q11 = u1 + u2 + u3
    q22 = u1 - u2 + u3
    q12 = u4 - u3
    q66 = (u1 - u4) / 2 - u3
    # (4)
    e1 = q11 - q12**2 / q22
    e2 = q22 - q12**2 / q11
    return np.array([e1 * stiffness, e2 * stiffness, q66 * stiffness, q12 / q22, e1 / e2, q66 / e1])
