"""Waves of the ring: its disturbances of azimuthal order 1 to 3, from the terms of these orders."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from membrane_ctrl.metrology.film.film_figure import FilmFigure
from membrane_ctrl.metrology.film.film_law import Bowl, HarmonicCause
from membrane_ctrl.metrology.film.misfit_average import (
    average_over_misfits,
    misfit_covariances,
    shared_covariance,
)
from membrane_ctrl.metrology.film.radial_quadrature import slope_radii
from membrane_ctrl.model.arrays import FloatArray, IntArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE, ZERNIKE_TERMS

_RING_SIGMAS: dict[HarmonicCause, float] = {"prestrain": 1e-3, "flat": 1.0, "round": 2.0}  # mm
_SURE = 4.0  # sigmas


@dataclass(frozen=True)
class RingWave:
    """One disturbance of the ring: amounts of cos(m theta) and sin(m theta), a strain or mm."""

    cause: HarmonicCause
    order: int
    amounts: FloatArray  # (2,)
    sigmas: FloatArray  # (2,)

    @property
    def seen(self) -> bool:
        """Whether it is there beyond doubt."""
        return bool(np.any(np.abs(self.amounts) > _SURE * self.sigmas))


def azimuthal_terms(order: int) -> IntArray:
    """Places among the parameters of the cosine and the sine terms of an azimuthal order, without
    tilt, (2, 3).
    """
    found: dict[int, list[int]] = {0: [], 1: []}
    j = 1
    for n in range(ZERNIKE_DEGREE + 1):
        for place in range(n + 1):
            m = n % 2 + 2 * ((place + (n + 1) % 2) // 2)
            if m == order and n > 1:
                found[j % 2].append(j - 2)  # Noll: even j are cosines
            j += 1
    return np.array([found[0], found[1]])


def fit_ring(
    figures: Sequence[FilmFigure], bowls: Bowl, reach: float, seen_mm: float
) -> tuple[tuple[RingWave, ...], FloatArray]:
    """Waves of the ring, and what they add to the figures' parameters (n, parameters)."""
    added = np.zeros((len(figures), ZERNIKE_TERMS))
    waves = []
    alike = misfit_covariances(figures)
    for order in (1, 2, 3):
        causes: list[HarmonicCause] = (
            ["prestrain", "flat", "round"] if order > 1 else ["prestrain", "round"]
        )
        terms = azimuthal_terms(order)
        response = np.stack(
            [_wave_terms_mm(bowls, order, cause, reach) for cause in causes], axis=-1
        )
        design = response.reshape(-1, len(causes))
        precision = np.array([_RING_SIGMAS[cause] ** -2 for cause in causes])
        found = []
        for parity in (0, 1):
            data = np.array([each.parameters_mm[terms[parity]] for each in figures]).ravel()
            noise = shared_covariance(figures, terms[parity]) + 1e-14 * np.eye(data.size)
            spread = np.stack([np.kron(part, np.eye(terms.shape[1])) for part in alike])
            allowed = average_over_misfits(
                design, data, noise, spread, np.zeros(len(causes)), precision, seen_mm
            )
            found.append(allowed)
            added[:, terms[parity]] = (response @ allowed.mean).reshape(len(figures), -1)
        for k, cause in enumerate(causes):
            amounts = np.array([each.mean[k] for each in found])
            sigmas = np.sqrt([each.covariance[k, k] for each in found])
            waves.append(RingWave(cause, order, amounts, sigmas))
    return tuple(waves), added


def _wave_terms_mm(bowls: Bowl, order: int, cause: HarmonicCause, reach: float) -> FloatArray:
    """Zernike terms (n, 3) of one unit of a ring's wave, as a fit of slopes inside `reach` finds
    them.
    """
    from scipy.special import eval_jacobi

    rho, weight = slope_radii(reach)

    def slopes(part: legendre.Legendre) -> FloatArray:
        value, climbs = part(rho**2), part.deriv()(rho**2)
        along = order * rho ** (order - 1) * value + 2 * rho ** (order + 1) * climbs
        return np.concatenate([along * weight, order * rho ** (order - 1) * value * weight])

    terms = []
    for n in range(order, ZERNIKE_DEGREE + 1, 2):
        # R_n^m / rho^m is the Jacobi polynomial P_k^(0, m)(2 v - 1), here by Legendre's least
        # squares (exact)
        jacobi = eval_jacobi((n - order) // 2, 0, order, 2 * rho**2 - 1)
        radial = legendre.Legendre.fit(rho**2, jacobi, ZERNIKE_DEGREE // 2, domain=[0, 1])
        terms.append(np.sqrt(2 * (n + 1)) * slopes(radial))
    onto = np.linalg.pinv(np.stack(terms).T)
    loads = zip(bowls.slackness.ravel(), bowls.load.ravel(), strict=True)
    each = (Bowl(np.asarray(s), np.asarray(q), bowls.poisson, bowls.radius_mm) for s, q in loads)
    found = np.array([onto @ slopes(bowl.harmonic(order, cause)) for bowl in each])
    return found[:, 1:] if order == 1 else found  # without tilt
