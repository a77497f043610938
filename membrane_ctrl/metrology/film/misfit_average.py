"""Least squares averaged over the size of a law's misfit and over the ways in which it grows.

No film obeys a law exactly. Its misfit is a random figure of unknown size that stays, or grows
with a power of the sag; both are estimated from the residuals.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.film.film_figure import FilmFigure
from membrane_ctrl.model.arrays import FloatArray, IntArray

# Parts of the misfit that differ between the sets, over the common one: a part that does not follow
# the sag, and one that does but is another figure.
_DIFFERS = 0.1
_UNRELATED = 0.5
# Sizes of the common misfit that are tried, over that of the terms that the law does not determine:
# it is not smaller than that.
_SIZES = np.logspace(0, 2.5, 12)
# Powers of the sag with which a misfit grows: a ring's figure stays, what a law leaves of large
# strains grows with the third power.
GROWTHS = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0])
# Width of the prior of the size, a Cauchy distribution of its natural logarithm.
_LOG_WIDTH = 1.0


def shared_covariance(figures: Sequence[FilmFigure], terms: IntArray) -> FloatArray:
    """Covariance of k terms of n sets.

    Each set has its own noise, and all share the geometry's error.

    Parameters
    ----------
    figures : sequence of FilmFigure
        The n sets.
    terms : (k,) int array
        Numbers of the terms.

    Returns
    -------
    (n k, n k) array
        In mm^2, set by set.
    """
    errors = np.vstack([each.geometry_mm[terms] for each in figures])
    out = errors @ errors.T
    for k, each in enumerate(figures):
        own = slice(k * len(terms), (k + 1) * len(terms))
        out[own, own] += each.noise_mm2[np.ix_(terms, terms)]
    return np.asarray(out)


def misfit_covariances(figures: Sequence[FilmFigure]) -> FloatArray:
    """Covariance (growths, n, n) over n sets of a misfit of size 1 that grows with the powers
    `GROWTHS` of the sag.
    """
    # A misfit g that all sets share grows as (sag / mean sag)^power: g g^T of each power.
    sags = np.array([each.sag_mm for each in figures])
    relative = sags / sags.mean()
    grown = relative[:, None] ** GROWTHS

    # Beside it a part that is linear in the sag's change, and one of each set alone, as large as
    # the sags differ.
    off = relative - 1
    follows_sag = _UNRELATED**2 * np.outer(off, off)
    of_each_set = _DIFFERS**2 * np.var(relative) * np.eye(sags.size)
    common = np.einsum("ig,jg->gij", grown, grown)
    return np.asarray(common + np.multiply.outer(GROWTHS**2, follows_sag + of_each_set))


@dataclass(frozen=True)
class Solved:
    """The unknowns of a linear model.

    Attributes
    ----------
    mean : (k,) array
        Their values.
    covariance : (k, k) array
        Their covariance.
    log_evidence : float
        Natural logarithm of the model's evidence, up to a constant; of several models that were
        averaged, that of their sum.
    size_mm : float
        Size of the misfit, RMS over those that were averaged.
    """

    mean: FloatArray
    covariance: FloatArray
    log_evidence: float
    size_mm: float = 0.0


def solve_linear(
    design: FloatArray,
    residual: FloatArray,
    noise: FloatArray,
    known: FloatArray,
    precision: FloatArray,
) -> Solved:
    """Least squares with correlated noise and a prior.

    Parameters
    ----------
    design : (m, k) array
        Derivatives of the data by the unknowns.
    residual : (m,) array
        Data less the model.
    noise : (m, m) array
        Covariance of the data.
    known, precision : (k,) arrays
        Values of the prior, and their inverse variances.
    """
    # Rows of unit variance: the data, whitened by the root of their covariance, and the prior.
    root = np.linalg.cholesky(noise)
    prior_rows = np.diag(np.sqrt(precision))
    rows = np.vstack([np.linalg.solve(root, design), prior_rows])
    right = np.append(np.linalg.solve(root, residual), np.sqrt(precision) * known)

    # Q R factors of the scaled rows: R^-1 is a root of the covariance.
    scale = np.sqrt(np.sum(rows**2, axis=0))
    q, r = np.linalg.qr(rows / scale)
    inverse = np.linalg.solve(r, np.eye(scale.size)) / scale[:, None]
    mean = inverse @ (q.T @ right)

    # Evidence: the sum of squares, and the logarithms of both determinants.
    left = np.sum((right - rows @ mean) ** 2)
    log_noise = np.sum(np.log(np.diag(root)))
    log_unknowns = np.sum(np.log(np.abs(np.diag(r)) * scale))
    log_evidence = float(-left / 2 - (log_noise + log_unknowns))
    return Solved(mean, inverse @ inverse.T, log_evidence)


def average_over_misfits(
    design: FloatArray,
    residual: FloatArray,
    noise: FloatArray,
    misfits: FloatArray,
    known: FloatArray,
    precision: FloatArray,
    misfit_mm: float,
) -> Solved:
    """Average the unknowns over the misfit's size and over the ways in which it grows.

    Each pair of size and growth is a model; its weight is its evidence times the prior of the size.

    Parameters
    ----------
    design, residual, noise, known, precision
        As those of `solve_linear`.
    misfits : (growths, m, m) array
        Covariances of a misfit of size 1.
    misfit_mm : float
        Size of the misfit in the terms that the law does not determine.
    """
    found = []
    for size_mm in misfit_mm * _SIZES:
        log_prior = -float(np.log1p((np.log(size_mm / misfit_mm) / _LOG_WIDTH) ** 2))
        for misfit in misfits:
            covariance = noise + size_mm**2 * misfit
            solved = solve_linear(design, residual, covariance, known, precision)
            log_weight = solved.log_evidence + log_prior
            found.append(replace(solved, log_evidence=log_weight, size_mm=float(size_mm)))
    return average_models(found)


def average_models(found: Sequence[Solved]) -> Solved:
    """Average models, each with the weight of its evidence."""
    # Evidence as weights, relative to the largest one: the exponentials do not overflow.
    logs = np.array([solved.log_evidence for solved in found])
    weight = np.exp(logs - logs.max())
    total = float(weight.sum())
    weight /= total

    # Mean over the models, and its covariance: within the models, and between their means.
    means = np.array([solved.mean for solved in found])
    mean = weight @ means
    covariances = np.array([solved.covariance for solved in found])
    within = np.einsum("k,kij->ij", weight, covariances)
    between = np.einsum("k,ki,kj->ij", weight, means - mean, means - mean)
    sizes_mm = np.array([solved.size_mm for solved in found])
    size_mm = float(np.sqrt(weight @ np.square(sizes_mm)))
    return Solved(mean, within + between, float(logs.max() + np.log(total)), size_mm)
