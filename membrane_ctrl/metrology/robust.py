"""A fit that dust, glints and wrinkled edges do not tilt: iteratively reweighted least squares on the slopes.

A point's weight depends on the length of its slope residual over the robust scatter of all of them. Huber's never
leaves a point out and cannot be misled; Tukey's leaves out what is further than 4.7 sigma and so forgets it wholly.

Source: P. J. Huber and E. M. Ronchetti, Robust Statistics, 2nd ed. (2009); the constants keep 95 % of the efficiency
of least squares for normal noise of one component, a little less for the length of two.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.reconstruct import Fit, Points, Tracer, solve

FloatArray = NDArray[np.float64]
Loss = Literal["huber", "tukey"]

_HUBER = 1.345
_TUKEY = 4.685
_RAYLEIGH_MEDIAN = 1.1774  # median length of a vector of two normal components of unit sigma
_LEAST_SIGMA = 1e-9  # a slope: below the rounding of any camera, so that a noise-free set keeps its points
_MAX_ROUNDS = 20
_SETTLED = 1e-3  # largest change of a weight


def robust_sigma(residual: FloatArray) -> float:
    """Scatter of one component from the median length of the residual vectors (2, n)."""
    return max(float(np.median(np.hypot(*residual))) / _RAYLEIGH_MEDIAN, _LEAST_SIGMA)


def robust_weights(residual: FloatArray, loss: Loss) -> FloatArray:
    """Weights (n,) in 0..1 of residual vectors (2, n), against their own robust scatter."""
    length = np.hypot(*residual) / robust_sigma(residual)
    if loss == "huber":
        return np.asarray(_HUBER / np.maximum(length, _HUBER))
    return np.asarray(np.square(np.clip(1 - np.square(length / _TUKEY), 0, None)))


def solve_robust(tracer: Tracer, points: Points, start: Fit, loss: Loss = "tukey") -> Fit:
    """Refit with weights from the residuals until they stand still.

    Parameters
    ----------
    points : Points
        Standing on the surface of `start`; their weights are multiplied by the robust ones in place.
    start : Fit
        Least-squares solution of the same points.

    Returns
    -------
    Fit
        `converged` also says that the weights stood still.
    """
    own = points.weights.copy()
    seen = own > 0
    fit, robust = start, np.ones_like(own)
    for _ in range(_MAX_ROUNDS):
        tracer.intersect(points, fit.surface)
        field = tracer.slope_field(points, fit.surface)
        fresh = np.zeros_like(own)
        fresh[seen] = robust_weights(field[2:4, seen] - field[4:6, seen], loss)
        change = float(np.max(np.abs(fresh - robust)[seen]))
        robust = fresh
        points.weights[:] = own * robust
        fit = solve(tracer, points, fit.surface)
        if change < _SETTLED:
            return fit
    return replace(fit, converged=False)
