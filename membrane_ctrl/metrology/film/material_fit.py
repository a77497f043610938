"""The film's material from figures at several pressures: pre-strain, Poisson ratio, stiffness, and
the ring's form.

Each figure gives its rotationally symmetric numbers: with 36 terms Noll 4, 11, 22 and the excess.
The law (`film_law`) predicts them from the pre-strain, the Poisson ratio and the set's own load q;
the gauge measures q = p a / (E t). Terms with azimuthal order 1 to 5 belong to the ring and to an
orthotropic film (`ring_waves`).

No film obeys a law exactly. Its misfit is a random figure of unknown size that stays, or grows
with a power of the sag; both are taken from what the law leaves, here and in the terms that it
says nothing about, and all results are averaged over what the figures allow. So a wrong law widens
the error bars instead of moving the numbers.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial import legendre, polynomial

from membrane_ctrl.metrology.film import finite_slopes, hencky_bowl
from membrane_ctrl.metrology.film.film_figure import FilmFigure
from membrane_ctrl.metrology.film.film_law import Bowl, FilmLaw
from membrane_ctrl.metrology.film.misfit_average import (
    GROWTHS,
    average_over_misfits,
    misfit_covariances,
    shared_covariance,
)
from membrane_ctrl.metrology.film.radial_quadrature import slope_radii
from membrane_ctrl.metrology.film.ring_waves import (
    CAUSES,
    RingWave,
    UnexplainedWaves,
    azimuthal_terms,
    fit_waves,
    unexplained_term_mm,
)
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

# What is known without the sets: films are stretched by some 0.1 %, and a polymer's Poisson ratio
# is 0.25 to 0.45
PRESTRAIN_SIGMA, POISSON, POISSON_SIGMA = 3e-3, 0.35, 0.1
# Round terms among a figure's parameters: those of Noll's order from 2 on, then the excess
ROUND = np.array([*(j - 2 for j in hencky_bowl.ROUND_NOLL[1:]), ZERNIKE_TERMS - 1])
_FREEDOM = np.append(np.ones(ROUND.size - 1), 0.1)  # of a misfit: the excess has 10 % of a term's
_ITERATIONS = 40
_LEAST_MM = 2e-4  # no film is trusted to follow the law more closely
_NEGLECTED = 0.005  # what Hooke's law misses of a film, of sag^3 / radius^2: 1 µm at 37 mm


@dataclass(frozen=True)
class Gauge:
    """What is known of the gauge: sigmas of a reading, of an offset, and of its scale."""

    noise_pa: float = 0.3
    offset_pa: float = 1.0
    scale: float = 1e-3


@dataclass(frozen=True)
class FilmFit:
    """A film as its figures show it."""

    law: FilmLaw  # its stiffness is meaningless without pressures
    covariance: FloatArray  # (3, 3): of pre-strain, Poisson ratio, relative stiffness
    # (n, parameters): what it leaves; 0 where it says nothing (tilt, orders above 5)
    left_mm: FloatArray
    waves: tuple[RingWave, ...]
    unexplained: tuple[UnexplainedWaves, ...]
    misfit_um: float  # 1 sigma of a term

    @property
    def sigmas(self) -> FloatArray:
        """1 sigma of pre-strain, Poisson ratio and relative stiffness."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def fit_film(
    figures: Sequence[FilmFigure], radius_mm: float, analysis_mm: float, gauge: Gauge
) -> FilmFit:
    """Fit the law to the figures of one film.

    Raises ValueError if there are fewer than two figures, or no film of the law is like them.
    """
    if len(figures) < 2:
        raise ValueError(
            "one set cannot tell pre-strain from Poisson ratio: two or more pressures are needed"
        )
    reach = analysis_mm / radius_mm
    sags_mm = np.array([[one.sag_mm] for one in figures])
    about = FilmLaw(0.0, POISSON, 1.0, radius_mm).with_sag(sags_mm)
    seen_mm = max(unexplained_term_mm(figures, about, reach), _LEAST_MM)
    unknowns, covariance, size_mm = _fit_round(figures, radius_mm, reach, gauge, seen_mm)
    law = FilmLaw(float(unknowns[0]), float(unknowns[1]), float(np.exp(unknowns[2])), radius_mm)
    bowls = law.loaded(np.exp(unknowns[3:, None]))
    of_waves = fit_waves(figures, bowls, reach, seen_mm)
    predicted = of_waves.added_mm
    predicted[:, ROUND] = round_terms_mm(bowls, reach) + _finite_terms_mm(law, bowls, reach)
    known = np.zeros(ZERNIKE_TERMS, bool)
    known[ROUND] = True
    for order in CAUSES:
        known[azimuthal_terms(order).ravel()] = True
    left = np.where(known, np.array([each.parameters_mm for each in figures]) - predicted, 0.0)
    return FilmFit(law, covariance, left, of_waves.waves, of_waves.unexplained, 1e3 * size_mm)


def round_terms_mm(bowls: Bowl, reach: float) -> FloatArray:
    """The round terms and the excess (n, k) that a fit of slopes inside `reach` radii finds in
    bowls (n, 1).
    """
    rho, weight, onto = _round_projection(reach)
    return np.asarray(bowls.rise_mm(rho) * weight @ onto.T)


def _finite_terms_mm(law: FilmLaw, bowls: Bowl, reach: float) -> FloatArray:
    """What finite slopes add to `round_terms_mm`: a hundredth, which hardly changes with the law's
    numbers.
    """
    rho, weight, onto = _round_projection(reach)
    rises = [finite_slopes.finite_rise_mm(law, float(load), rho) for load in bowls.load.ravel()]
    return np.asarray((rises - bowls.rise_mm(rho)) * weight @ onto.T)


@cache
def _round_projection(reach: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Radii, weights, and the least squares of slopes there onto these terms."""
    rho, weight = slope_radii(reach)
    x = 2 * rho**2 - 1
    round_degrees = [*enumerate(np.eye(hencky_bowl.EXCESS_DEGREE))][1:]
    slopes = [
        np.sqrt(2 * k + 1) * 4 * rho * legendre.legval(x, legendre.legder(unit))
        for k, unit in round_degrees
    ]
    excess = (
        2
        * rho
        * polynomial.polyval(rho**2, polynomial.polyder(hencky_bowl.excess_series()))
        / hencky_bowl.excess_rms()
    )
    return rho, weight, np.asarray(np.linalg.pinv((np.stack([*slopes, excess]) * weight).T))


def _fit_round(
    figures: Sequence[FilmFigure], radius_mm: float, reach: float, gauge: Gauge, seen_mm: float
) -> tuple[FloatArray, FloatArray, float]:
    """Unknowns (pre-strain, Poisson ratio, log stiffness, log loads), covariance (3, 3), misfit."""
    count = len(figures)
    pressure = np.array([each.pressure_pa for each in figures])
    sag_mm = float(np.mean([each.sag_mm for each in figures]))
    seen_mm = max(seen_mm, _NEGLECTED * sag_mm**3 / radius_mm**2)
    gauged = np.isfinite(pressure)
    log_q = np.log(pressure[gauged] * radius_mm * 1e-3)
    data = np.array([each.parameters_mm[ROUND] for each in figures]).ravel()
    finite = np.zeros((count, len(ROUND)))

    def bent(x: FloatArray) -> tuple[FilmLaw, Bowl]:
        law = FilmLaw(float(x[0]), float(x[1]), 1.0, radius_mm)
        return law, law.loaded(np.exp(x[3:, None]))

    def predict(x: FloatArray) -> FloatArray:
        return np.append((round_terms_mm(bent(x)[1], reach) + finite).ravel(), x[3:][gauged] + x[2])

    offset = gauge.offset_pa / pressure[gauged]
    of_gauge = (
        np.outer(offset, offset)
        + gauge.scale**2
        + np.diag((gauge.noise_pa / pressure[gauged]) ** 2)
    )
    shared = shared_covariance(figures, ROUND)
    noise = np.zeros((len(data) + len(log_q),) * 2)
    noise[: len(data), : len(data)], noise[len(data) :, len(data) :] = shared, of_gauge
    misfits = np.zeros((GROWTHS.size, *noise.shape))
    misfits[:, : len(data), : len(data)] = [
        np.kron(part, np.diag(_FREEDOM**2)) for part in misfit_covariances(figures)
    ]
    known = np.append([0.0, POISSON, 12.0], np.zeros(count))
    precision = np.append([PRESTRAIN_SIGMA**-2, POISSON_SIGMA**-2, 1e-4], np.full(count, 1e-6))
    start = FilmLaw(0.0, POISSON, 1.0, radius_mm).with_sag(
        np.array([each.sag_mm for each in figures])
    )
    x = np.append([0.0, POISSON, 12.0], np.log(start.load))
    x[2], target = (
        float(np.mean(log_q - x[3:][gauged])) if gauged.any() else x[2],
        np.append(data, log_q),
    )
    far = True
    for _ in range(_ITERATIONS):
        finite[:] = _finite_terms_mm(*bent(x), reach)
        slopes, rest = _numerical_slopes(predict, x), target - predict(x)
        tried = average_over_misfits(
            slopes, rest, noise, misfits[-far:], known - x, precision, seen_mm
        )  # far: one will do
        step = tried.mean * _limit_step(x, tried.mean)
        x = x + step
        near = np.all(np.abs(step[:3]) < 0.05 * np.sqrt(np.diag(tried.covariance)[:3]))
        if near and not far:
            return x, tried.covariance[:3, :3], tried.size_mm
        far = far and not near
    raise ValueError(
        "no film of the law is like these figures: they are of different films, or of a "
        "wrong geometry"
    )


def _limit_step(x: FloatArray, step: FloatArray) -> float:
    """The part of a step that stays among films: Poisson ratio in 0 .. 0.5, loads by less than a
    factor of two.
    """
    scale = min(
        1.0, 0.5 / max(float(np.max(np.abs(step[3:]))), 1e-9), 2e-3 / max(abs(float(step[0])), 1e-9)
    )
    while not 0 <= x[1] + scale * step[1] <= 0.5:
        scale /= 2
        if scale < 1e-4:
            raise ValueError(
                "the figures ask for a Poisson ratio outside 0 .. 0.5: the geometry or the "
                "law is wrong"
            )
    return scale


def _numerical_slopes(predict: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    columns = []
    for k in range(x.size):
        step = np.zeros(x.size)
        step[k] = 1e-6
        columns.append((predict(x + step) - predict(x - step)) / 2e-6)
    return np.stack(columns, axis=1)
