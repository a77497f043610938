"""The film's material from figures at several pressures: pre-strain, Poisson ratio, stiffness, and
the ring's form.

Each figure gives its rotationally symmetric numbers: with 36 terms Noll 4, 11, 22 and the excess.
The law (`film_law`) predicts them from the pre-strain, the Poisson ratio and the set's own load q;
the gauge measures q = p a / (E t). Terms with azimuthal order 1 to 5 belong to the ring and to an
orthotropic film (`ring_waves`).

No film obeys a law exactly. Its misfit is a random figure of unknown size that stays, or grows
with a power of the sag; both are taken from what the law leaves, here and in the terms that it
contain no evidence about, and all results are averaged over what the figures allow. So a wrong law
widens the error bars instead of moving the numbers.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.polynomial import legendre, polynomial

from membrane_ctrl.metrology.film import finite_slopes, hencky_bowl
from membrane_ctrl.metrology.film.film_figure import FilmFigure
from membrane_ctrl.metrology.film.film_law import Bowl, FilmLaw
from membrane_ctrl.metrology.film.misfit_average import (
    GROWTHS,
    Solved,
    average_models,
    average_over_misfits,
    misfit_covariances,
    shared_covariance,
)
from membrane_ctrl.metrology.film.orthotropy import OrthotropicFilm, find_orthotropy
from membrane_ctrl.metrology.film.radial_quadrature import slope_radii
from membrane_ctrl.metrology.film.ring_waves import (
    CAUSES,
    CausesTogether,
    RingWave,
    SharedWaves,
    UnexplainedWaves,
    azimuthal_terms,
    fit_waves,
    unexplained_term_mm,
)
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

# Prior without any set: films are stretched by some 0.1 %, and a polymer's Poisson ratio is 0.25 to
# 0.45.
PRESTRAIN_SIGMA = 3e-3
POISSON = 0.35
POISSON_SIGMA = 0.1
_LOG_STIFFNESS = 12.0  # start and prior of the natural logarithm of E t in N/m
_LOG_STIFFNESS_PRECISION = 1e-4  # inverse variance
_LOG_LOAD_PRECISION = 1e-6
# Round terms among a figure's parameters: those of Noll's order from 2 on, then the excess.
ROUND = np.array([*(j - 2 for j in hencky_bowl.ROUND_NOLL[1:]), ZERNIKE_TERMS - 1])
# Size of a misfit in each round term: the excess has 10 % of that of a term.
_FREEDOM = np.append(np.ones(ROUND.size - 1), 0.1)
_LEAST_MM = 2e-4  # least misfit: no film is assumed to follow the law more closely
_NEGLECTED = 0.005  # misfit of Hooke's law over sag^3 / radius^2: 1 µm at 37 mm
_ITERATIONS = 40
# Sizes of a misfit over that of the terms without a law, one after the other until a fit converges.
_TIMES_EXPECTED = (1.0, 10.0, 100.0)
_NEAR_SIGMAS = 0.05  # of a step: the solution is near
_SLOPE_STEP = 1e-6  # of the central differences
# Largest steps of the logarithms of the loads and of the pre-strain.
_LARGEST_LOG_STEP = 0.5
_LARGEST_STRAIN_STEP = 2e-3


@dataclass(frozen=True)
class Gauge:
    """Standard uncertainties of the pressure gauge.

    Attributes
    ----------
    noise_pa : float
        Of a reading.
    offset_pa : float
        Of its offset.
    scale : float
        Of its scale, relative.
    """

    noise_pa: float = 0.3
    offset_pa: float = 1.0
    scale: float = 1e-3


@dataclass(frozen=True)
class FilmFit:
    """A film as its figures show it.

    Attributes
    ----------
    law : FilmLaw
        The film; its stiffness has no meaning without pressures.
    covariance : (3, 3) array
        Covariance of pre-strain, Poisson ratio and relative stiffness.
    left_mm : (n, parameters) array
        What the law leaves of each figure; 0 in terms that it does not determine (tilt, azimuthal
        orders above 5).
    waves : tuple of RingWave
        Waves of the ring with a cause.
    unexplained : tuple of UnexplainedWaves
        Waves without one.
    shared : tuple of SharedWaves
        Waves that are the same in all sets and of no cause.
    together : tuple of CausesTogether
        Causes of waves that are known only together.
    orthotropy : OrthotropicFilm or None
        Elastic constants by direction; None if waves of two or four have another cause.
    misfit_um : float
        1 sigma of a term.
    """

    law: FilmLaw
    covariance: FloatArray
    left_mm: FloatArray
    waves: tuple[RingWave, ...]
    unexplained: tuple[UnexplainedWaves, ...]
    shared: tuple[SharedWaves, ...]
    together: tuple[CausesTogether, ...]
    orthotropy: OrthotropicFilm | None
    misfit_um: float

    @property
    def sigmas(self) -> FloatArray:
        """1 sigma of pre-strain, Poisson ratio and relative stiffness."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def fit_film(
    figures: Sequence[FilmFigure], radius_mm: float, analysis_mm: float, gauge: Gauge
) -> FilmFit:
    """Fit the law to the figures of one film.

    Parameters
    ----------
    figures : sequence of FilmFigure
        Figures at different pressures.
    radius_mm : float
        Radius of the ring.
    analysis_mm : float
        Radius within which the figures were fitted.
    gauge : Gauge
        Uncertainties of the pressures.

    Returns
    -------
    FilmFit

    Raises
    ------
    ValueError
        If there are fewer than two figures, or no film of the law fits them.
    """
    if len(figures) < 2:
        raise ValueError(
            "one set cannot separate pre-strain and Poisson ratio: two or more pressures are needed"
        )
    reach = analysis_mm / radius_mm

    # Size of the misfit, from the terms that the law does not determine.
    sags_mm = np.array([[figure.sag_mm] for figure in figures])
    typical_bowls = FilmLaw(0.0, POISSON, 1.0, radius_mm).with_sag(sags_mm)
    misfit_mm = max(unexplained_term_mm(figures, typical_bowls, reach), _LEAST_MM)

    # The film by the round terms, then the waves of its ring.
    unknowns, covariance, size_mm = _fit_round_of_any_misfit(
        figures, radius_mm, reach, gauge, misfit_mm
    )
    prestrain, poisson, log_stiffness = unknowns[:3]
    law = FilmLaw(float(prestrain), float(poisson), float(np.exp(log_stiffness)), radius_mm)
    bowls = law.under_load(np.exp(unknowns[3:, None]))
    of_waves = fit_waves(figures, bowls, reach, misfit_mm)

    # What both leave of the figures.
    predicted_mm = of_waves.added_mm
    predicted_mm[:, ROUND] = round_terms_mm(bowls, reach) + _finite_terms_mm(law, bowls, reach)
    is_predicted = np.zeros(ZERNIKE_TERMS, bool)
    is_predicted[ROUND] = True
    for order in CAUSES:
        is_predicted[azimuthal_terms(order).ravel()] = True
    seen = np.array([figure.parameters_mm for figure in figures])
    left_mm = np.where(is_predicted, seen - predicted_mm, 0.0)
    return FilmFit(
        law=law,
        covariance=covariance,
        left_mm=left_mm,
        waves=of_waves.waves,
        unexplained=of_waves.unexplained,
        shared=of_waves.shared,
        together=of_waves.together,
        orthotropy=find_orthotropy(law, covariance, of_waves.waves),
        misfit_um=1e3 * size_mm,
    )


def round_terms_mm(bowls: Bowl, reach: float) -> FloatArray:
    """The round terms and the excess that a fit of slopes finds in bowls.

    Parameters
    ----------
    bowls : Bowl
        (n, 1) of them.
    reach : float
        Radius of the analysis over that of the mirror.

    Returns
    -------
    (n, k) array
        In mm.
    """
    rho, weight, onto = _round_projection(reach)
    return np.asarray(bowls.rise_mm(rho) * weight @ onto.T)


def _finite_terms_mm(law: FilmLaw, bowls: Bowl, reach: float) -> FloatArray:
    """What finite slopes add to `round_terms_mm` (n, k), mm: a hundredth, which hardly changes with
    the law's numbers.
    """
    rho, weight, onto = _round_projection(reach)
    rises = [finite_slopes.finite_rise_mm(law, float(load), rho) for load in bowls.load.ravel()]
    return np.asarray((rises - bowls.rise_mm(rho)) * weight @ onto.T)


@cache
def _round_projection(reach: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Radii (m,), their weights (m,), and the matrix (k, m) from weighted slopes there to the round
    terms and the excess, by least squares.
    """
    rho, weight = slope_radii(reach)

    # Slopes of the round terms, sqrt(2 k + 1) P_k(2 rho^2 - 1), and of the excess.
    x = 2 * rho**2 - 1
    slopes = []
    for k, unit in enumerate(np.eye(hencky_bowl.EXCESS_DEGREE)):
        if k == 0:
            continue  # piston
        slope = legendre.legval(x, legendre.legder(unit))
        slopes.append(np.sqrt(2 * k + 1) * 4 * rho * slope)
    excess_slope = polynomial.polyval(rho**2, polynomial.polyder(hencky_bowl.excess_series()))
    slopes.append(2 * rho * excess_slope / hencky_bowl.excess_rms())
    return rho, weight, np.asarray(np.linalg.pinv((np.stack(slopes) * weight).T))


def _fit_round_of_any_misfit(
    figures: Sequence[FilmFigure], radius_mm: float, reach: float, gauge: Gauge, misfit_mm: float
) -> tuple[FloatArray, FloatArray, float]:
    """As `_fit_round`; a misfit far above that of the terms without a law is tried, too.

    A round figure that all sets share, such as 20 µm of Noll 11 from a lens, is no reason to refuse
    them: the steps diverge only because so large a misfit is not expected at the first of them.
    """
    refused: ValueError | None = None
    for times in _TIMES_EXPECTED:
        try:
            return _fit_round(figures, radius_mm, reach, gauge, times * misfit_mm)
        except ValueError as error:
            refused = refused or error
    assert refused is not None
    raise refused


def _fit_round(
    figures: Sequence[FilmFigure], radius_mm: float, reach: float, gauge: Gauge, misfit_mm: float
) -> tuple[FloatArray, FloatArray, float]:
    """Fit the law to the round terms of n figures, by Gauss-Newton.

    Data are the round terms and the excess of each figure, and the logarithm of each gauged load.

    Parameters
    ----------
    figures, radius_mm, gauge
        As those of `fit_film`.
    reach : float
        Radius of the fitted area over that of the ring.
    misfit_mm : float
        Size of the misfit in other terms.

    Returns
    -------
    unknowns : (3 + n,) array
        Pre-strain, Poisson ratio, logarithm of the stiffness, logarithms of the loads.
    covariance : (3, 3) array
        Of the first three.
    size_mm : float
        Size of the misfit.
    """
    count = len(figures)
    sags_mm = np.array([figure.sag_mm for figure in figures])
    sag_mm = float(np.mean(sags_mm))
    misfit_mm = max(misfit_mm, _NEGLECTED * sag_mm**3 / radius_mm**2)

    # The data. The gauge's pressure times the radius is the load times the stiffness.
    pressure_pa = np.array([figure.pressure_pa for figure in figures])
    is_gauged = np.isfinite(pressure_pa)
    log_q = np.log(pressure_pa[is_gauged] * radius_mm * 1e-3)
    terms = np.array([figure.parameters_mm[ROUND] for figure in figures]).ravel()
    target = np.append(terms, log_q)
    finite_mm = np.zeros((count, len(ROUND)))

    def make_bowls(x: FloatArray) -> tuple[FilmLaw, Bowl]:
        """The film and its bowls for the unknowns (3 + n,)."""
        law = FilmLaw(float(x[0]), float(x[1]), 1.0, radius_mm)
        return law, law.under_load(np.exp(x[3:, None]))

    def predict(x: FloatArray) -> FloatArray:
        """The data for the unknowns (3 + n,)."""
        _, bowls = make_bowls(x)
        predicted_mm = round_terms_mm(bowls, reach) + finite_mm
        return np.append(predicted_mm.ravel(), x[3:][is_gauged] + x[2])

    noise, misfits = _assemble_covariances(figures, gauge, pressure_pa[is_gauged])

    # The prior, and the start: Hencky's film at each sag.
    known = np.append([0.0, POISSON, _LOG_STIFFNESS], np.zeros(count))
    precisions = [PRESTRAIN_SIGMA**-2, POISSON_SIGMA**-2, _LOG_STIFFNESS_PRECISION]
    precision = np.append(precisions, np.full(count, _LOG_LOAD_PRECISION))
    start = FilmLaw(0.0, POISSON, 1.0, radius_mm).with_sag(sags_mm)
    x = np.append([0.0, POISSON, _LOG_STIFFNESS], np.log(start.load))
    if is_gauged.any():
        x[2] = float(np.mean(log_q - x[3:][is_gauged]))

    def converge(x: FloatArray, tried_misfits: FloatArray) -> tuple[FloatArray, Solved]:
        """Gauss-Newton from the unknowns x (3 + n,) with some of the misfits: where it ends, and
        the answer there. Raises ValueError if it does not converge.
        """
        for _ in range(_ITERATIONS):
            # The law about the present unknowns: its slopes, and what it leaves.
            finite_mm[:] = _finite_terms_mm(*make_bowls(x), reach)
            slopes = _numerical_slopes(predict, x)
            rest = target - predict(x)
            solved = average_over_misfits(
                slopes, rest, noise, tried_misfits, known - x, precision, misfit_mm
            )
            # Near the solution a step is far below its error; before, it is limited.
            sigmas = np.sqrt(np.diag(solved.covariance)[:3])
            if np.all(np.abs(solved.mean[:3]) < _NEAR_SIGMAS * sigmas):
                return x + solved.mean, replace(solved, mean=x + solved.mean)
            x = x + solved.mean * _limit_step(x, solved.mean)
        raise ValueError(
            "no film of the law is like these figures: they are of different films, or of a "
            "wrong geometry"
        )

    # The misfit that grows fastest allows most: its solution is where those of the others begin.
    # Each growth is judged at its own solution. A misfit that stays the same has to explain the
    # sets' differences to the noise, and the law is not linear to the noise over many sigmas.
    x, solved = converge(x, misfits[-1:])
    found = [solved]
    for misfit in misfits[-2::-1]:
        try:
            x, solved = converge(x, misfit[None])
        except ValueError:  # no film of the law leaves such a misfit
            continue
        found.append(solved)
    whole = average_models(found)
    return whole.mean, whole.covariance[:3, :3], whole.size_mm


def _assemble_covariances(
    figures: Sequence[FilmFigure], gauge: Gauge, gauged_pa: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariance (data, data) of the data by their noise, and those (growths, data, data) by a
    misfit of size 1 of each growth.

    Data are the round terms and the excess of each figure, and the logarithm of each gauged load.
    """
    # A gauge has an offset and a scale, which all its readings share, and noise.
    offset = gauge.offset_pa / gauged_pa
    reading_noise = (gauge.noise_pa / gauged_pa) ** 2
    of_gauge = np.outer(offset, offset) + gauge.scale**2 + np.diag(reading_noise)

    # Terms and loads have independent errors; a misfit is one of the terms.
    split = len(figures) * len(ROUND)
    size = split + gauged_pa.size
    noise = np.zeros((size, size))
    noise[:split, :split] = shared_covariance(figures, ROUND)
    noise[split:, split:] = of_gauge
    misfits = np.zeros((GROWTHS.size, size, size))
    of_terms = np.diag(_FREEDOM**2)
    for misfit, of_figures in zip(misfits, misfit_covariances(figures), strict=True):
        misfit[:split, :split] = np.kron(of_figures, of_terms)
    return noise, misfits


def _limit_step(x: FloatArray, step: FloatArray) -> float:
    """Share of a step that stays among films: Poisson ratio in 0 .. 0.5, loads by less than a
    factor of two.

    `x` and `step` (3 + n,) are the unknowns and their step. Raises ValueError if no part of it
    stays there.
    """
    log_step = max(float(np.max(np.abs(step[3:]))), 1e-9)
    strain_step = max(abs(float(step[0])), 1e-9)
    scale = min(1.0, _LARGEST_LOG_STEP / log_step, _LARGEST_STRAIN_STEP / strain_step)
    while not 0 <= x[1] + scale * step[1] <= 0.5:
        scale /= 2
        if scale < 1e-4:
            raise ValueError(
                "the figures ask for a Poisson ratio outside 0 .. 0.5: the geometry or the "
                "law is wrong"
            )
    return scale


def _numerical_slopes(predict: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    """Derivatives (m, k) of a prediction (m,) by its unknowns x (k,), by central differences."""
    columns = []
    for k in range(x.size):
        step = np.zeros(x.size)
        step[k] = _SLOPE_STEP
        change = predict(x + step) - predict(x - step)
        columns.append(change / (2 * _SLOPE_STEP))
    return np.stack(columns, axis=1)
