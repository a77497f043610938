"""The film's material from figures at several pressures: pre-strain, Poisson ratio, stiffness, and
the ring's form.

Each figure gives its rotationally symmetric numbers: with 36 terms Noll 4, 11, 22 and the excess.
The law (`film_law`) predicts them from the pre-strain, the Poisson ratio and the set's own load q;
the gauge says q = p a / (E t). Terms with azimuthal order 1 to 3 belong to the ring: a pre-strain
that varies, a ring that is not flat or not round.

No film obeys a law exactly. Its misfit is a random figure of unknown size that stays, or grows with
a power of the sag; both are taken from what the law leaves, here and in the terms that it says
nothing about, and all results are averaged over what the figures allow. So a wrong law widens the
error bars instead of moving the numbers.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial import legendre, polynomial

from membrane_ctrl.metrology.film import finite_slopes, hencky_bowl
from membrane_ctrl.metrology.film.film_law import Bowl, FilmLaw, HarmonicCause
from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.model.arrays import FloatArray, IntArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE, ZERNIKE_TERMS

# What is known without the sets: films are stretched by some 0.1 %, and a polymer's Poisson ratio
# is 0.25 to 0.45
PRESTRAIN_SIGMA, POISSON, POISSON_SIGMA = 3e-3, 0.35, 0.1
_RING_SIGMAS: dict[HarmonicCause, float] = {"prestrain": 1e-3, "flat": 1.0, "round": 2.0}  # mm
_ROUND = np.array(
    [*(j - 2 for j in hencky_bowl.ROUND_NOLL[1:]), PARAMETERS - 1]
)  # places among a figure's parameters
_FREEDOM = np.append(
    np.ones(_ROUND.size - 1), 0.1
)  # of a misfit: the excess has a tenth of a term's
# Of the misfit that differs between the sets: what does not follow the sag, and what does but is
# another figure
_DIFFERS, _UNRELATED = 0.1, 0.5
_LEAST_MM = 2e-4  # no film is trusted to follow the law more closely
_TIMES_SEEN = np.logspace(
    0, 2.5, 12
)  # sizes of the common misfit: never below that of the terms without a law
# Powers of the sag with which a misfit grows: a ring's figure stays, what a law leaves of large
# strains grows by 3
_GROWTHS = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0])
_NEGLECTED = 0.005  # what Hooke's law misses of a film, of sag^3 / radius^2: 1 µm at 37 mm
# misfit over that of the terms without a law: natural logarithm, of a Cauchy distribution
_UNLIKE = 1.0
_SURE = 4.0  # sigmas
_NODES = _ITERATIONS = 40


@dataclass(frozen=True)
class FilmFigure:
    """One set's figure."""

    name: str
    parameters_mm: FloatArray  # (parameters,), as of `Surface.parameters`
    noise_mm2: FloatArray  # (parameters, parameters): covariance from the pixels' noise
    # (parameters, k): change with each independent error of the geometry by its sigma
    geometry_mm: FloatArray
    pressure_pa: float  # NaN without a gauge
    sag_mm: float


@dataclass(frozen=True)
class Gauge:
    """What is known of the gauge: sigmas of a reading, of an offset, and of its scale."""

    noise_pa: float = 0.3
    offset_pa: float = 1.0
    scale: float = 1e-3


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


@dataclass(frozen=True)
class FilmFit:
    """A film as its figures show it."""

    law: FilmLaw  # its stiffness is meaningless without pressures
    covariance: FloatArray  # (3, 3): of pre-strain, Poisson ratio, relative stiffness
    # (n, parameters): what it leaves; 0 where it says nothing (tilt, orders above 3)
    left_mm: FloatArray
    waves: tuple[RingWave, ...]
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
    seen_mm = _seen_mm(figures)
    unknowns, covariance, size_mm = _fit_round(figures, radius_mm, reach, gauge, seen_mm)
    law = FilmLaw(float(unknowns[0]), float(unknowns[1]), float(np.exp(unknowns[2])), radius_mm)
    bowls = law.loaded(np.exp(unknowns[3:, None]))
    waves, predicted = _fit_ring(figures, bowls, reach, seen_mm)
    predicted[:, _ROUND] = round_terms_mm(bowls, reach) + _finite_terms_mm(law, bowls, reach)
    known = np.zeros(ZERNIKE_TERMS, bool)
    known[_ROUND] = True
    for order in (1, 2, 3):
        known[_terms(order).ravel()] = True
    left = np.where(known, np.array([each.parameters_mm for each in figures]) - predicted, 0.0)
    return FilmFit(law, covariance, left, waves, 1e3 * size_mm)


def _seen_mm(figures: Sequence[FilmFigure]) -> float:
    """Size of a term that no law of this module has, from those with azimuthal orders of 4 and
    more.
    """
    others = np.concatenate([_terms(order).ravel() for order in range(4, ZERNIKE_DEGREE + 1)])
    squares = [
        each.parameters_mm[others] ** 2 - np.diag(each.noise_mm2)[others] for each in figures
    ]
    return float(np.sqrt(max(np.mean(squares), _LEAST_MM**2)))


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
    rho, weight = _radii(reach)
    x = 2 * rho**2 - 1
    round_degrees = [*enumerate(np.eye(hencky_bowl.EXCESS_DEGREE))][1:]
    slopes = [
        np.sqrt(2 * k + 1) * 4 * rho * legendre.legval(x, legendre.legder(unit))
        for k, unit in round_degrees
    ]
    excess = (
        2
        * rho
        * polynomial.polyval(rho**2, polynomial.polyder(hencky_bowl.excess()))
        / hencky_bowl.excess_rms()
    )
    return rho, weight, np.asarray(np.linalg.pinv((np.stack([*slopes, excess]) * weight).T))


def _radii(reach: float) -> tuple[FloatArray, FloatArray]:
    """Gauss' nodes along the radius, and the roots of the areas that they stand for."""
    nodes, weights = legendre.leggauss(_NODES)
    rho = reach * (nodes + 1) / 2
    return rho, np.sqrt(weights * rho)


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
    data = np.array([each.parameters_mm[_ROUND] for each in figures]).ravel()
    finite = np.zeros((count, len(_ROUND)))

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
    shared = _shared(figures, _ROUND)
    noise = np.zeros((len(data) + len(log_q),) * 2)
    noise[: len(data), : len(data)], noise[len(data) :, len(data) :] = shared, of_gauge
    misfits = np.zeros((_GROWTHS.size, *noise.shape))
    misfits[:, : len(data), : len(data)] = [
        np.kron(part, np.diag(_FREEDOM**2)) for part in _alike(figures)
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
        slopes, rest = _slopes(predict, x), target - predict(x)
        tried = _averaged(
            slopes, rest, noise, misfits[-far:], known - x, precision, seen_mm
        )  # far: one will do
        step = tried.mean * _inside(x, tried.mean)
        x = x + step
        near = np.all(np.abs(step[:3]) < 0.05 * np.sqrt(np.diag(tried.covariance)[:3]))
        if near and not far:
            return x, tried.covariance[:3, :3], tried.size_mm
        far = far and not near
    raise ValueError(
        "no film of the law is like these figures: they are of different films, or of a "
        "wrong geometry"
    )


def _inside(x: FloatArray, step: FloatArray) -> float:
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


def _slopes(predict: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    columns = []
    for k in range(x.size):
        step = np.zeros(x.size)
        step[k] = 1e-6
        columns.append((predict(x + step) - predict(x - step)) / 2e-6)
    return np.stack(columns, axis=1)


def _shared(figures: Sequence[FilmFigure], terms: IntArray) -> FloatArray:
    """Covariance of some terms of all sets: each its noise,
    the geometry's error the same for all.
    """
    errors = np.vstack([each.geometry_mm[terms] for each in figures])
    out = errors @ errors.T
    for k, each in enumerate(figures):
        own = slice(k * len(terms), (k + 1) * len(terms))
        out[own, own] += each.noise_mm2[np.ix_(terms, terms)]
    return np.asarray(out)


def _alike(figures: Sequence[FilmFigure]) -> FloatArray:
    """Covariance (growths, n, n) over the sets of a misfit of size 1 that grows with these powers
    of the sag.
    """
    sags = np.array([each.sag_mm for each in figures])
    deeper = sags / sags.mean()
    grows, off = deeper[:, None] ** _GROWTHS, deeper - 1
    differs = _UNRELATED**2 * np.outer(off, off) + _DIFFERS**2 * np.var(deeper) * np.eye(sags.size)
    return np.asarray(
        np.einsum("ig,jg->gij", grows, grows) + np.multiply.outer(_GROWTHS**2, differs)
    )


@dataclass(frozen=True)
class _Solved:
    """A linear model's unknowns."""

    mean: FloatArray
    covariance: FloatArray
    log_evidence: float
    size_mm: float = 0.0


def _solved(
    design: FloatArray,
    residual: FloatArray,
    noise: FloatArray,
    known: FloatArray,
    precision: FloatArray,
) -> _Solved:
    """Least squares; `known` with its `precision` is the prior."""
    root = np.linalg.cholesky(noise)
    a, b = np.linalg.solve(root, design), np.linalg.solve(root, residual)
    rows, right = (
        np.vstack([a, np.diag(np.sqrt(precision))]),
        np.append(b, np.sqrt(precision) * known),
    )
    scale = np.sqrt(np.sum(rows**2, axis=0))
    q, r = np.linalg.qr(rows / scale)
    inverse = np.linalg.solve(r, np.eye(scale.size)) / scale[:, None]
    mean = inverse @ (q.T @ right)
    left = np.sum((right - rows @ mean) ** 2)
    volume = np.sum(np.log(np.diag(root))) + np.sum(np.log(np.abs(np.diag(r)) * scale))
    return _Solved(mean, inverse @ inverse.T, float(-left / 2 - volume))


def _averaged(
    design: FloatArray,
    residual: FloatArray,
    noise: FloatArray,
    misfits: FloatArray,
    known: FloatArray,
    precision: FloatArray,
    seen_mm: float,
) -> _Solved:
    """The unknowns averaged over the misfit's size, about `seen_mm`, and over the ways in which it
    grows.
    """
    found, logs, sizes = [], [], []
    for size in seen_mm * _TIMES_SEEN:
        for misfit in misfits:
            one = _solved(design, residual, noise + size**2 * misfit, known, precision)
            found.append(one)
            sizes.append(size)
            logs.append(one.log_evidence - float(np.log1p((np.log(size / seen_mm) / _UNLIKE) ** 2)))
    weight = np.exp(np.array(logs) - np.max(logs))
    weight /= weight.sum()
    means = np.array([one.mean for one in found])
    mean = weight @ means
    within = np.einsum("k,kij->ij", weight, np.array([one.covariance for one in found]))
    covariance = within + np.einsum("k,ki,kj->ij", weight, means - mean, means - mean)
    return _Solved(mean, covariance, float(np.max(logs)), float(np.sqrt(weight @ np.square(sizes))))


def _terms(order: int) -> IntArray:
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


def _fit_ring(
    figures: Sequence[FilmFigure], bowls: Bowl, reach: float, seen_mm: float
) -> tuple[tuple[RingWave, ...], FloatArray]:
    """Waves of the ring, and what they add to the figures' parameters (n, parameters)."""
    added = np.zeros((len(figures), ZERNIKE_TERMS))
    waves = []
    alike = _alike(figures)
    for order in (1, 2, 3):
        causes: list[HarmonicCause] = (
            ["prestrain", "flat", "round"] if order > 1 else ["prestrain", "round"]
        )
        terms = _terms(order)
        response = np.stack(
            [_wave_terms_mm(bowls, order, cause, reach) for cause in causes], axis=-1
        )
        design = response.reshape(-1, len(causes))
        precision = np.array([_RING_SIGMAS[cause] ** -2 for cause in causes])
        found = []
        for parity in (0, 1):
            data = np.array([each.parameters_mm[terms[parity]] for each in figures]).ravel()
            noise = _shared(figures, terms[parity]) + 1e-14 * np.eye(data.size)
            spread = np.stack([np.kron(part, np.eye(terms.shape[1])) for part in alike])
            allowed = _averaged(
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

    rho, weight = _radii(reach)

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
