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


@dataclass(frozen=True)
class _LawFit:
    """The law for one onset, one bend and one correlation of the noise."""

    log_evidence: float
    drift: float  # from the last reading to the time ahead
    drift_variance: float
    per_decade: float
    scatter: float


def fit_creep(time_s: FloatArray, y: FloatArray, ahead_s: float) -> FilmCreep:
    """Fit the law to readings of a film's stiffness.

    Parameters
    ----------
    time_s : (n,) array
        Times of the readings, in any order.
    y : (n,) array
        Logarithm of the stiffness then.
    ahead_s : float
        How far beyond the last reading to predict the drift.

    Raises
    ------
    ValueError
        For fewer than `LEAST` readings, or a look ahead of more than twice their time.
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
            f"readings over {span_s / 3600:.1f} h do not predict {ahead_s / 3600:.0f} h ahead"
        )
    t = np.append((time_s - time_s[0]) / span_s, 1 + ahead_s / span_s)
    # One fit for each combination of the three unknown settings, weighted with its evidence
    fits = [
        _fit_law(t, y, onset, bend, lasting)
        for onset, bend, lasting in product(_ONSETS, _BENDS, _LASTING)
    ]
    evidence = np.array([fit.log_evidence for fit in fits])
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    drifts = np.array([fit.drift for fit in fits])
    variances = np.array([fit.drift_variance for fit in fits])
    drift = float(weight @ drifts)
    # The variance of a mixture: that of each fit, and the scatter between the fits
    variance = float(weight @ (variances + (drifts - drift) ** 2))
    per_decade = float(weight @ np.array([fit.per_decade for fit in fits]))
    scatter = float(weight @ np.array([fit.scatter for fit in fits]))
    return FilmCreep(span_s, per_decade, drift, math.sqrt(variance), scatter)


def _average_blocks(time_s: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means over blocks of equal time."""
    span_s = float(np.ptp(time_s)) if time_s.size else 0.0
    if time_s.size <= _BLOCKS or span_s == 0:
        return time_s, y
    # The block of each reading; the last reading belongs to the last block.
    block = ((time_s - time_s[0]) / span_s * _BLOCKS).astype(int)
    block = np.minimum(block, _BLOCKS - 1)

    # Means over the blocks that have readings.
    count = np.bincount(block)
    full = count > 0
    mean_time_s = np.bincount(block, time_s)[full] / count[full]
    mean_y = np.bincount(block, y)[full] / count[full]
    return mean_time_s, mean_y


def _fit_law(t: FloatArray, y: FloatArray, onset: float, bend: float, lasting: float) -> _LawFit:
    """Fit one law by generalised least squares, and predict its drift.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning (2006): covariance of
    the cubic spline in section 6.3.1, explicit basis functions in section 2.7.

    Parameters
    ----------
    t : (n + 1,) array
        Times in units of the readings' time; the last one is ahead of the n readings.
    y : (n,) array
        Readings.
    onset : float
        t0, in the unit of t.
    bend : float
        Scale of W, in sigma of the noise.
    lasting : float
        Correlation of the noise from one reading to the next.
    """
    u = np.log(t + onset) - math.log(onset)

    # Covariance of W, an integrated random walk from u = 0.
    earlier = np.minimum.outer(u, u)
    later = np.maximum.outer(u, u)
    curve = bend**2 * earlier**2 * (3 * later - earlier) / 6

    # Covariance of the noise, in its own variance: a first-order autoregressive process
    number = np.arange(y.size)
    noise = lasting ** np.abs(np.subtract.outer(number, number))

    # Whiten the line's two columns, the readings, and the covariance of the drift with the readings
    root = np.linalg.cholesky(curve[:-1, :-1] + noise)
    line_columns = np.stack([np.ones(y.size), u[:-1] - u[-2]], axis=1)
    drift_covariance = curve[:-1, -1] - curve[:-1, -2]
    whitened = np.linalg.solve(root, np.column_stack([line_columns, y, drift_covariance]))
    columns = whitened[:, :2]
    readings = whitened[:, 2]
    gain = whitened[:, 3]

    # Least squares for the line a + b u; its residual carries W
    normal = columns.T @ columns
    inverse = np.linalg.inv(normal)
    line = inverse @ (columns.T @ readings)
    residual = readings - columns @ line
    freedom = y.size - 2
    variance = max(float(residual @ residual), 1e-30) / freedom

    # Drift from the last reading to the time ahead: of the line, and of W
    step = np.array([0.0, u[-1] - u[-2]])
    drift = float(step @ line + gain @ residual)

    # Its variance: of W given the readings, and of the line that is estimated from them
    of_curve = curve[-1, -1] + curve[-2, -2] - 2 * curve[-1, -2] - gain @ gain
    untaken = step - columns.T @ gain
    of_line = untaken @ inverse @ untaken

    # Marginal likelihood, with the line and the noise's variance integrated out
    evidence = (
        -np.sum(np.log(np.diag(root)))
        - np.linalg.slogdet(normal)[1] / 2
        - freedom / 2 * math.log(variance)
    )
    return _LawFit(
        log_evidence=float(evidence),
        drift=drift,
        drift_variance=variance * float(of_curve + of_line),
        per_decade=math.log(10) * drift / float(u[-1] - u[-2]),
        scatter=math.sqrt(variance),
    )
