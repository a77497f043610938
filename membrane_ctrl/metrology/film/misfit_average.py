"""Least squares averaged over the size of a law's misfit and over the ways in which it grows.

No film obeys a law exactly. Its misfit is a random figure of unknown size that stays, or grows
with a power of the sag; both are estimated from the residuals.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.film.film_figure import FilmFigure
from membrane_ctrl.model.arrays import FloatArray, IntArray

# Of the misfit that differs between the sets: what does not follow the sag, and what does but is
# another figure
_DIFFERS, _UNRELATED = 0.1, 0.5
_TIMES_SEEN = np.logspace(
    0, 2.5, 12
)  # sizes of the common misfit: never below that of the terms without a law
# Powers of the sag with which a misfit grows: a ring's figure stays, what a law leaves of large
# strains grows by 3
GROWTHS = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0])
# misfit over that of the terms without a law: natural logarithm, of a Cauchy distribution
_UNLIKE = 1.0


def shared_covariance(figures: Sequence[FilmFigure], terms: IntArray) -> FloatArray:
    """Covariance of some terms of all sets: each its noise,
    the geometry's error the same for all.
    """
    errors = np.vstack([each.geometry_mm[terms] for each in figures])
    out = errors @ errors.T
    for k, each in enumerate(figures):
        own = slice(k * len(terms), (k + 1) * len(terms))
        out[own, own] += each.noise_mm2[np.ix_(terms, terms)]
    return np.asarray(out)


def misfit_covariances(figures: Sequence[FilmFigure]) -> FloatArray:
    """Covariance (growths, n, n) over the sets of a misfit of size 1 that grows with these powers
    of the sag.
    """
    sags = np.array([each.sag_mm for each in figures])
    deeper = sags / sags.mean()
    grows, off = deeper[:, None] ** GROWTHS, deeper - 1
    differs = _UNRELATED**2 * np.outer(off, off) + _DIFFERS**2 * np.var(deeper) * np.eye(sags.size)
    return np.asarray(
        np.einsum("ig,jg->gij", grows, grows) + np.multiply.outer(GROWTHS**2, differs)
    )


@dataclass(frozen=True)
class Solved:
    """A linear model's unknowns."""

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
    return Solved(mean, inverse @ inverse.T, float(-left / 2 - volume))


def average_over_misfits(
    design: FloatArray,
    residual: FloatArray,
    noise: FloatArray,
    misfits: FloatArray,
    known: FloatArray,
    precision: FloatArray,
    seen_mm: float,
) -> Solved:
    """The unknowns averaged over the misfit's size, about `seen_mm`, and over the ways in which it
    grows.
    """
    found, logs, sizes = [], [], []
    for size in seen_mm * _TIMES_SEEN:
        for misfit in misfits:
            one = solve_linear(design, residual, noise + size**2 * misfit, known, precision)
            found.append(one)
            sizes.append(size)
            logs.append(one.log_evidence - float(np.log1p((np.log(size / seen_mm) / _UNLIKE) ** 2)))
    weight = np.exp(np.array(logs) - np.max(logs))
    weight /= weight.sum()
    means = np.array([one.mean for one in found])
    mean = weight @ means
    within = np.einsum("k,kij->ij", weight, np.array([one.covariance for one in found]))
    covariance = within + np.einsum("k,ki,kj->ij", weight, means - mean, means - mean)
    return Solved(mean, covariance, float(np.max(logs)), float(np.sqrt(weight @ np.square(sizes))))
