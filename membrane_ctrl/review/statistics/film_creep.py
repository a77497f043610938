"""Creep of a film: fits its law to the stiffness over time, and predicts tomorrow's drift.

A loaded film continues to stretch, ever more slowly. Polymers creep about evenly in the logarithm
of the time since the load, or by a small power of it, but none exactly. So y, the logarithm of the
stiffness E t that sag and pressure show, is a curve over u = ln(t + t0),

    y = a + b u + W(u) + noise

with W a curve of unknown bends (the integral of a random walk: a smoothing spline). A power law is
such a curve. How much it bends, t0, and for how long the noise lasts (weather makes errors of
hours) are not known: the results are averages over all three, weighted with how well each agrees
with the readings.
"""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

LEAST = 8  # readings: fewer determine no law
_BLOCKS = 60
_ONSETS = np.logspace(-4, 0.5, 8)  # t0 over the time of the readings
_BENDS = np.append(0.0, np.logspace(-2, 4, 10))  # of W over a unit of u, in the noise's sigma
_LASTING = (0.0, 0.5, 0.8, 0.95)  # correlation of the noise from one reading to the next
_AHEAD = 2.0  # longest look ahead over the time of the readings


@dataclass(frozen=True)
class FilmCreep:
    """What the readings show of one film."""

    span_s: float  # from the first reading to the last
    per_decade: float  # of y, at the end, when the time since the load grows tenfold
    drift: float  # of y over the time that was asked for, from the last reading on, and its 1 sigma
    drift_sigma: float
    scatter: float  # of a reading about the law

    @property
    def is_certain(self) -> bool:
        """Whether the film creeps at all, beyond doubt."""
        return abs(self.drift) > 2 * self.drift_sigma


def fit_creep(time_s: FloatArray, y: FloatArray, ahead_s: float) -> FilmCreep:
    """Fit the law to readings (n,) of the logarithm of the stiffness.

    Raises ValueError for fewer than `LEAST` readings, or a look ahead of more than twice their
    time.
    """
    order = np.argsort(time_s)
    time_s, y = _average_blocks(np.asarray(time_s, float)[order], np.asarray(y, float)[order])
    if time_s.size < LEAST:
        raise ValueError(
            f"{time_s.size} readings are too few for a law of creep; {LEAST} are needed"
        )
    span_s = float(time_s[-1] - time_s[0])
    if ahead_s > _AHEAD * span_s:
        raise ValueError(
            f"readings over {span_s / 3600:.1f} h say nothing of {ahead_s / 3600:.0f} h ahead"
        )
    t = np.append((time_s - time_s[0]) / span_s, 1 + ahead_s / span_s)
    found = np.array([_fit_law(t, y, *each) for each in product(_ONSETS, _BENDS, _LASTING)])
    weight = np.exp(found[:, 0] - np.max(found[:, 0]))
    weight /= weight.sum()
    _, drifts, variances, decades, scatters = found.T
    drift = float(weight @ drifts)
    sigma = math.sqrt(float(weight @ (variances + (drifts - drift) ** 2)))
    return FilmCreep(span_s, float(weight @ decades), drift, sigma, float(weight @ scatters))


def _average_blocks(time_s: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means over blocks of equal time."""
    span_s = float(np.ptp(time_s)) if time_s.size else 0.0
    if time_s.size <= _BLOCKS or span_s == 0:
        return time_s, y
    block = np.minimum(((time_s - time_s[0]) / span_s * _BLOCKS).astype(int), _BLOCKS - 1)
    count = np.bincount(block)
    full = count > 0
    return np.bincount(block, time_s)[full] / count[full], np.bincount(block, y)[full] / count[full]


def _fit_law(
    t: FloatArray, y: FloatArray, onset: float, bend: float, lasting: float
) -> tuple[float, float, float, float, float]:
    """One law: log evidence, drift to the last t from the one before, its variance, drift per
    decade, scatter.

    t (n + 1,) is in units of the readings' time; the last one is ahead of the n readings y.
    """
    u = np.log(t + onset) - math.log(onset)
    less, more = np.minimum.outer(u, u), np.maximum.outer(u, u)
    curve = bend**2 * less**2 * (3 * more - less) / 6
    noise = lasting ** np.abs(np.subtract.outer(np.arange(y.size), np.arange(y.size)))
    root = np.linalg.cholesky(curve[:-1, :-1] + noise)
    design = np.stack([np.ones(y.size), u[:-1] - u[-2]], axis=1)
    both = np.linalg.solve(root, np.column_stack([design, y, curve[:-1, -1] - curve[:-1, -2]]))
    a, b, onto = both[:, :2], both[:, 2], both[:, 3]
    inverse = np.linalg.inv(a.T @ a)
    line = inverse @ (a.T @ b)
    left, free = b - a @ line, y.size - 2
    variance = max(float(left @ left), 1e-30) / free
    step = np.array([0.0, u[-1] - u[-2]])
    drift = float(step @ line + onto @ left)
    short = step - a.T @ onto
    own = curve[-1, -1] + curve[-2, -2] - 2 * curve[-1, -2] - onto @ onto + short @ inverse @ short
    evidence = (
        -np.sum(np.log(np.diag(root)))
        - np.linalg.slogdet(a.T @ a)[1] / 2
        - free / 2 * math.log(variance)
    )
    decade = math.log(10) * drift / float(u[-1] - u[-2])
    return float(evidence), drift, variance * float(own), decade, math.sqrt(variance)
