"""Waves of a figure: what the ring and an uneven film add, by azimuthal order.

Each cause has a profile along the radius, and follows the sag in its own way: a ring that is not
flat adds the same at any sag, an orthotropic film in proportion to it. A cause is stated only where
these signatures explain the waves of its order; else the order's cause is unknown.

A figure that all sets share competes with the causes: an error of the lens, the mount or the
geometry has any profile, and stays. Both hypotheses, with it and without, are fitted and weighted
by their evidence. Where it is likely, a cause is known only from what changes with the sag.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre

from membrane_ctrl.metrology.film.film_figure import FilmFigure
from membrane_ctrl.metrology.film.film_law import Bowl, HarmonicCause
from membrane_ctrl.metrology.film.misfit_average import (
    Solved,
    average_models,
    average_over_misfits,
    misfit_covariances,
    shared_covariance,
)
from membrane_ctrl.metrology.film.radial_quadrature import slope_radii
from membrane_ctrl.model.arrays import FloatArray, IntArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE, ZERNIKE_TERMS

# What may cause waves of each azimuthal order. A tilted ring (flat, 1) cannot be separated from a
# tilted bench.
CAUSES: dict[int, tuple[HarmonicCause, ...]] = {
    1: ("prestrain", "round"),
    2: ("prestrain", "flat", "round", "modulus"),
    3: ("prestrain", "flat", "round"),
    4: ("flat", "shear"),
    5: ("flat",),
}
# Standard uncertainty of each cause before any measurement: a strain, mm, or a share of a modulus.
_CAUSE_SIGMAS: dict[HarmonicCause, float] = {
    "prestrain": 1e-3,
    "flat": 1.0,
    "round": 2.0,
    "modulus": 0.1,
    "shear": 0.3,
}
_OF_FILM = ("modulus", "shear")
# Causes that strain the film: finite slopes change their waves. A ring that is not flat bends it.
_BY_STRAIN = (*_OF_FILM, "prestrain", "round")
# Standard uncertainty, before any measurement, of a term of a figure that all sets share: that of a
# lens or a mount.
_SHARED_SIGMA_MM = 0.3
# Least misfit of a term beside a shared figure. Without one, the terms that no law determines show
# how much the sets share besides the causes.
_LEAST_MISFIT_MM = 2e-4
SURE_SIGMAS = 4.0  # beyond which a cause is stated
_FOEPPL = 0.03  # relative change of their waves by finite slopes
# Share of the shear modulus that the square of the moduli's difference adds to four waves.
_SECOND_ORDER = 2.0
# Waves of order a + b and |a - b| that two waves a and b make in second order, over the product of
# their RMS over the sag. Films of finite strains with two waves (a ring out of round and of flat
# beside unequal moduli) leave 1.4 to 1.7 of the square as four waves.
_PRODUCT = 2.0
_UNEXPLAINED = 0.1  # share of an order's waves: if more is left, there is another cause
_LEAST_STATED_MM = 2e-3  # least RMS of an order's terms that is stated
_TOGETHER = 0.95  # correlation of two causes that the sets determine only together
_FIRST_FREE_ORDER = 4  # orders from here on show how large terms without a cause are


@dataclass(frozen=True)
class RingWave:
    """One cause of waves.

    Attributes
    ----------
    cause : HarmonicCause
        The cause.
    order : int
        m.
    amounts, sigmas : (2,) arrays
        Amounts of cos(m theta) and sin(m theta), a strain, mm or a share; their uncertainties.
    explained : bool
        Whether all causes together explain the waves of this order.
    """

    cause: HarmonicCause
    order: int
    amounts: FloatArray
    sigmas: FloatArray
    explained: bool

    @property
    def is_sure(self) -> bool:
        """Whether the cause is there beyond doubt."""
        return self.explained and bool(np.any(np.abs(self.amounts) > SURE_SIGMAS * self.sigmas))


@dataclass(frozen=True)
class UnexplainedWaves:
    """Waves of an azimuthal order that no cause of the law explains.

    Attributes
    ----------
    order : int
        m.
    rms_um : float
        RMS of the waves over the disc.
    left_um : float
        RMS of what the causes leave.
    likely : tuple of HarmonicCause
        The causes, by what each leaves alone; the best first.
    """

    order: int
    rms_um: float
    left_um: float
    likely: tuple[HarmonicCause, ...]


@dataclass(frozen=True)
class SharedWaves:
    """Waves that may be a figure that all sets share; no cause is seen beyond doubt.

    Attributes
    ----------
    order : int
        m.
    rms_um : float
        RMS over the disc.
    weight : float
        Probability that there is such a figure; the rest is that of the causes alone.
    likely : tuple of HarmonicCause
        The causes, by what each leaves alone; the best first.
    """

    order: int
    rms_um: float
    weight: float
    likely: tuple[HarmonicCause, ...]


@dataclass(frozen=True)
class CausesTogether:
    """Two causes of waves that the sets determine only together.

    Attributes
    ----------
    order : int
        m.
    causes : (HarmonicCause, HarmonicCause)
    correlation : float
        Of their amounts.
    factor : float
        The sets determine the first amount less `factor` times the second,
    sigma : float
        to this standard uncertainty.
    """

    order: int
    causes: tuple[HarmonicCause, HarmonicCause]
    correlation: float
    factor: float
    sigma: float


@dataclass(frozen=True)
class WaveFit:
    """All causes, the orders without one, and what the causes add to the figures.

    Attributes
    ----------
    waves : tuple of RingWave
        All causes.
    unexplained : tuple of UnexplainedWaves
        Orders without a cause.
    shared : tuple of SharedWaves
        Orders that the sets may share, without a cause beyond doubt.
    together : tuple of CausesTogether
        Causes that are known only together.
    added_mm : (n, parameters) array
        What causes and shared waves add to the parameters of each figure.
    """

    waves: tuple[RingWave, ...]
    unexplained: tuple[UnexplainedWaves, ...]
    shared: tuple[SharedWaves, ...]
    together: tuple[CausesTogether, ...]
    added_mm: FloatArray


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


def fit_waves(
    figures: Sequence[FilmFigure], bowls: Bowl, reach: float, misfit_mm: float
) -> WaveFit:
    """Causes of the waves in the figures.

    Parameters
    ----------
    figures : sequence of FilmFigure
        Figures of one film, (n,).
    bowls : Bowl
        The film of the law in each of them, (n, 1).
    reach : float
        Radius of the analysed disc in radii of the ring.
    misfit_mm : float
        Size of a term that no law explains.

    Returns
    -------
    WaveFit
    """
    added = np.zeros((len(figures), ZERNIKE_TERMS))
    waves: list[RingWave] = []
    unexplained: list[UnexplainedWaves] = []
    shared: list[SharedWaves] = []
    together: list[CausesTogether] = []
    sizes_mm = {order: _wave_rms_mm(_list_terms(figures, order)) for order in CAUSES}
    sag_mm = float(np.mean([one.sag_mm for one in figures]))
    for order, causes in CAUSES.items():
        # Cosine and sine terms of the order, (2, n, 3), and their fit by its causes.
        terms = azimuthal_terms(order)
        response = wave_responses_mm(bowls, order, reach)
        data = _list_terms(figures, order)
        product_mm = _PRODUCT * _product_mm(sizes_mm, order, sag_mm)
        fits = [
            _fit_parity(figures, terms[k], causes, response, data[k], misfit_mm, product_mm)
            for k in (0, 1)
        ]
        predicted = np.stack([response @ one.amounts + one.shared_mm for one in fits])
        for parity, of_parity in enumerate(predicted):
            added[:, terms[parity]] = of_parity

        # Do the causes and what all sets share explain the waves?
        left = data - predicted
        rms_mm = sizes_mm[order]
        left_mm = _wave_rms_mm(left)
        explained = left_mm < max(_UNEXPLAINED * rms_mm, 2 * misfit_mm, product_mm)
        likely = _rank_causes(causes, response, data)
        together += _find_causes_together(order, causes, fits[0].covariance)
        for k, cause in enumerate(causes):
            amounts = np.array([one.amounts[k] for one in fits])
            sigmas = np.sqrt([one.covariance[k, k] for one in fits])
            waves.append(RingWave(cause, order, amounts, sigmas, explained))
        if rms_mm < _LEAST_STATED_MM:
            continue
        if not explained:
            unexplained.append(UnexplainedWaves(order, 1e3 * rms_mm, 1e3 * left_mm, likely))
        elif not any(wave.is_sure for wave in waves[-len(causes) :]):
            weight = max(one.shared_weight for one in fits)
            shared.append(SharedWaves(order, 1e3 * rms_mm, weight, likely))
    return WaveFit(_widen_shear(waves), tuple(unexplained), tuple(shared), tuple(together), added)


def _list_terms(figures: Sequence[FilmFigure], order: int) -> FloatArray:
    """Cosine and sine terms (2, n, k) of an azimuthal order in n figures, mm."""
    terms = azimuthal_terms(order)
    return np.stack([[one.parameters_mm[part] for one in figures] for part in terms])


def _wave_rms_mm(terms_mm: FloatArray) -> float:
    """RMS over disc and figures of waves (2, n, k)."""
    return float(np.sqrt(np.sum(terms_mm**2) / terms_mm.shape[1]))


def _product_mm(sizes_mm: dict[int, float], order: int, sag_mm: float) -> float:
    """Sum of the products of the waves (RMS by order) that make waves of an order, over the sag."""
    products_mm2 = [
        sizes_mm[a] * sizes_mm[b]
        for a in sizes_mm
        for b in sizes_mm
        if a <= b and order in (a + b, b - a)
    ]
    return sum(products_mm2) / sag_mm


def _widen_shear(waves: list[RingWave]) -> tuple[RingWave, ...]:
    """The waves; the shear's sigma with what the square of the moduli's difference adds."""
    moduli = max(float(np.hypot(*one.amounts)) for one in waves if one.cause == "modulus")
    added = _SECOND_ORDER * moduli**2
    return tuple(
        replace(one, sigmas=np.hypot(one.sigmas, added)) if one.cause == "shear" else one
        for one in waves
    )


@dataclass(frozen=True)
class _ParityFit:
    """The cosine or the sine terms of an order by its causes and a figure that all sets share.

    Attributes
    ----------
    amounts : (causes,) array
        Of the causes.
    covariance : (causes, causes) array
        Of the amounts.
    shared_mm : (terms,) array
        The figure that all sets share.
    shared_weight : float
        Probability that there is such a figure.
    """

    amounts: FloatArray
    covariance: FloatArray
    shared_mm: FloatArray
    shared_weight: float


def _fit_parity(
    figures: Sequence[FilmFigure],
    terms: IntArray,
    causes: Sequence[HarmonicCause],
    response: FloatArray,
    data: FloatArray,
    misfit_mm: float,
    product_mm: float,
) -> _ParityFit:
    """Fit the cosine or the sine terms of an order.

    Parameters
    ----------
    figures : sequence of FilmFigure
        n of them.
    terms : (k,) array
        Places of the terms among a figure's parameters.
    causes : sequence of HarmonicCause
    response : (n, k, causes) array
        Terms of one unit of each cause, mm.
    data : (n, k) array
        The terms, mm.
    misfit_mm : float
        Size of a term that no law explains.
    product_mm : float
        Size of waves of second order, which grow with the sag.
    """
    noise = shared_covariance(figures, terms) + 1e-14 * np.eye(data.size)
    # A wave's misfit grows in several ways at once: a cause leaves another power of the sag than a
    # figure without one. A single power would have to explain the sets' differences to the noise,
    # which only a misfit as large as the wave does; the causes would then be free.
    mixed: FloatArray = np.mean(misfit_covariances(figures), axis=0)
    spread: FloatArray = np.kron(mixed, np.eye(terms.size))[None].astype(np.float64)
    count = len(causes)
    of_film = [k for k, cause in enumerate(causes) if cause in _OF_FILM]
    by_strain = [k for k, cause in enumerate(causes) if cause in _BY_STRAIN]
    by_causes = response.reshape(-1, count)
    by_shared_terms = np.tile(np.eye(terms.size), (len(figures), 1))
    cause_sigmas = np.array([_CAUSE_SIGMAS[cause] for cause in causes])
    shared_sigmas = np.full(terms.size, _SHARED_SIGMA_MM)

    def solve(design: FloatArray, prior_sigmas: FloatArray, least_mm: float) -> Solved:
        """The unknowns of one hypothesis, causes first; least_mm is the least misfit of a term."""
        nothing = np.zeros(prior_sigmas.size)
        precision = prior_sigmas**-2

        def average(size_mm: float) -> Solved:
            return average_over_misfits(
                design, data.ravel(), noise, spread, nothing, precision, size_mm
            )

        def widen(found: Solved, chosen: list[int]) -> float:
            waves_mm = response[..., chosen] @ found.mean[chosen]
            return float(np.hypot(least_mm, _FOEPPL * np.sqrt(np.mean(waves_mm**2))))

        # What finite slopes change of an orthotropic film's waves follows from their size.
        found = average(widen(average(least_mm), of_film))
        # So does what they change of the waves of a clamping. That is in the bars only: a clamping
        # that explains another cause's waves badly must not become likely by it.
        size_mm = widen(found, by_strain)
        return replace(average(size_mm), log_evidence=found.log_evidence)

    # The two hypotheses, both with the causes' amounts and the shared terms as unknowns.
    alone = solve(by_causes, cause_sigmas, float(np.hypot(misfit_mm, product_mm)))
    padded = np.zeros((count + terms.size, count + terms.size))
    padded[:count, :count] = alone.covariance
    without = replace(alone, mean=np.append(alone.mean, np.zeros(terms.size)), covariance=padded)
    with_shared = solve(
        np.hstack([by_causes, by_shared_terms]),
        np.append(cause_sigmas, shared_sigmas),
        float(np.hypot(_LEAST_MISFIT_MM, product_mm)),
    )
    both = average_models([without, with_shared])
    weight = 1 / (1 + np.exp(np.clip(without.log_evidence - with_shared.log_evidence, -500, 500)))
    return _ParityFit(
        both.mean[:count], both.covariance[:count, :count], both.mean[count:], float(weight)
    )


def _find_causes_together(
    order: int, causes: Sequence[HarmonicCause], covariance: FloatArray
) -> list[CausesTogether]:
    """Pairs of causes whose amounts are correlated so far that only a combination is known."""
    sigmas = np.sqrt(np.diag(covariance))
    found = []
    for second in range(len(causes)):
        for first in range(second):
            correlation = float(covariance[first, second] / (sigmas[first] * sigmas[second]))
            if abs(correlation) < _TOGETHER:
                continue
            factor = float(covariance[first, second] / covariance[second, second])
            sigma = float(sigmas[first] * np.sqrt(1 - correlation**2))
            pair = causes[first], causes[second]
            found.append(CausesTogether(order, pair, correlation, factor, sigma))
    return found


def _rank_causes(
    causes: Sequence[HarmonicCause], response: FloatArray, data: FloatArray
) -> tuple[HarmonicCause, ...]:
    """The causes by what each leaves alone, the best first."""
    both = data.reshape(2, -1)
    left = []
    for k in range(len(causes)):
        column = response[..., k].ravel()
        amounts = both @ column / (column @ column)
        left.append(float(np.sum((both - np.outer(amounts, column)) ** 2)))
    return tuple(causes[k] for k in np.argsort(left))


def unexplained_term_mm(figures: Sequence[FilmFigure], bowls: Bowl, reach: float) -> float:
    """RMS of a term that no cause explains, from the azimuthal orders of 4 and more, without noise.

    Parameters
    ----------
    figures, bowls, reach
        As in `fit_waves`.

    Returns
    -------
    float
        0 if these orders have no term beyond the causes, as with 21 Zernike terms.
    """
    squares = 0.0
    freedom = 0
    for order in range(_FIRST_FREE_ORDER, ZERNIKE_DEGREE + 1):
        for terms in azimuthal_terms(order):
            data = np.array([one.parameters_mm[terms] for one in figures])
            noise = sum(float(np.sum(np.diag(one.noise_mm2)[terms])) for one in figures)
            # A ring that is not flat adds one number, the same to all figures; it is fitted first.
            fitted = 0
            if "flat" in CAUSES.get(order, ()):
                fitted = 1
                columns = wave_responses_mm(bowls, order, reach)
                columns = columns.reshape(-1, columns.shape[-1])
                amounts = np.linalg.lstsq(columns, data.ravel(), rcond=None)[0]
                data = data - (columns @ amounts).reshape(data.shape)
            # What is left beyond the noise, per figure and free number.
            squares += (float(np.sum(data**2)) - noise) / len(figures)
            freedom += terms.size - fitted
    if freedom:
        return float(np.sqrt(max(squares / freedom, 0.0)))
    return 0.0


def wave_responses_mm(bowls: Bowl, order: int, reach: float) -> FloatArray:
    """Zernike terms of one unit of each cause of an azimuthal order.

    Parameters
    ----------
    bowls : Bowl
        (n, 1) of them.
    order : int
        Waves around the ring.
    reach : float
        Radius of the analysis over that of the mirror.

    Returns
    -------
    (n, k, causes) array
        In mm.
    """
    columns = [_wave_terms_mm(bowls, order, cause, reach) for cause in CAUSES[order]]
    return np.stack(columns, axis=-1)


def _wave_terms_mm(bowls: Bowl, order: int, cause: HarmonicCause, reach: float) -> FloatArray:
    """Zernike terms (n, 3) of one unit of a ring's wave, as a fit of slopes inside `reach` finds
    them.
    """
    from scipy.special import eval_jacobi

    rho, weight = slope_radii(reach)

    def compute_slopes(part: legendre.Legendre) -> FloatArray:
        """Weighted slopes along the radius and around, of rho^m part(rho^2)."""
        value = part(rho**2)
        derivative = part.deriv()(rho**2)
        around = order * rho ** (order - 1) * value
        along = around + 2 * rho ** (order + 1) * derivative
        return np.concatenate([along * weight, around * weight])

    # Slopes of the order's Zernike terms. R_n^m / rho^m is the Jacobi polynomial P_k^(0, m)(2 v -
    # 1), here by Legendre's least squares (exact).
    terms = []
    for n in range(order, ZERNIKE_DEGREE + 1, 2):
        jacobi = eval_jacobi((n - order) // 2, 0, order, 2 * rho**2 - 1)
        radial = legendre.Legendre.fit(rho**2, jacobi, ZERNIKE_DEGREE // 2, domain=[0, 1])
        terms.append(np.sqrt(2 * (n + 1)) * compute_slopes(radial))
    onto_terms = np.linalg.pinv(np.stack(terms).T)

    # Least squares of the wave's slopes onto them, in each bowl.
    found = []
    for slackness, load in zip(bowls.slackness.ravel(), bowls.load.ravel(), strict=True):
        bowl = Bowl(np.asarray(slackness), np.asarray(load), bowls.poisson, bowls.radius_mm)
        found.append(onto_terms @ compute_slopes(bowl.harmonic(order, cause)))
    terms_mm = np.array(found)
    if order == 1:
        return terms_mm[:, 1:]  # without tilt
    return terms_mm
