"""From the spread of the parameters to the spread of the height, and the linear covariance beside the Monte Carlo.

The fitted height is linear in the 36 parameters, h = P a, so its standard deviation at every point follows from
their covariance C alone: sigma^2 = diag(P C P^T). With C the sample covariance of the trials that is, to the last
bit of rounding, the standard deviation over the trials' heights: the paper's RMSE map.

Linear: C = J S J^T + C_noise with S the covariance of the geometry and J the change of the parameters with it, from
two solutions a number (some ms each); J hardly changes while the film moves by micrometres, so a live loop works it
out once a full cycle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology import hencky
from membrane_ctrl.metrology.covariance import parameter_covariance
from membrane_ctrl.metrology.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.monte_carlo import TrialBench
from membrane_ctrl.metrology.reconstruct import Fit
from membrane_ctrl.metrology.surface import PARAMETERS, parameter_to_coeffs
from membrane_ctrl.metrology.zernike import values

FloatArray = NDArray[np.float64]

MAP_SIDE = 101  # points across a map: 10 mm a cell, far below what 36 terms can change over


@dataclass(frozen=True)
class HeightMap:
    """Points of a square grid inside a radius, and the matrix that makes heights of parameters there.

    Attributes
    ----------
    axis_mm : (n,) array
        Of x and of y.
    inside : (n, n) bool array
        Rows along y.
    matrix : (points, 36) array
        Heights, 0 at the vertex, of the points inside.
    """

    axis_mm: FloatArray
    inside: NDArray[np.bool_]
    matrix: FloatArray

    @classmethod
    def over(cls, analysis_radius_mm: float, radius_mm: float, side: int = MAP_SIDE) -> HeightMap:
        """A grid over the analysis radius; `radius_mm` is that of the Zernike disc."""
        axis = np.linspace(-analysis_radius_mm, analysis_radius_mm, side)
        x, y = np.meshgrid(axis, axis)
        inside = np.hypot(x, y) <= analysis_radius_mm
        return cls(axis, inside, height_matrix(x[inside], y[inside], radius_mm))

    def picture(self, heights: FloatArray) -> FloatArray:
        """(n, n) of values at the points inside; NaN outside."""
        out = np.full(self.inside.shape, np.nan)
        out[self.inside] = heights
        return out

    def sigma(self, covariance: FloatArray) -> FloatArray:
        """(points,) standard deviation for a covariance (36, 36) of the parameters, in its unit."""
        variance = np.einsum("pi,pi->p", self.matrix @ covariance, self.matrix)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def height_matrix(x_mm: FloatArray, y_mm: FloatArray, radius_mm: float) -> FloatArray:
    """Matrix (points, 36) from parameters to heights, 0 at the vertex."""
    x, y = np.asarray(x_mm) / radius_mm, np.asarray(y_mm) / radius_mm
    out = np.asarray(values(x, y).T @ parameter_to_coeffs())
    out[:, -1] += np.polynomial.polynomial.polyval(x * x + y * y, hencky.excess()) / hencky.excess_rms()
    return out


def trial_covariance(parameters: FloatArray) -> FloatArray:
    """Covariance (36, 36) over trials (trials, 36)."""
    return np.atleast_2d(np.cov(parameters, rowvar=False))


def geometry_jacobian(bench: TrialBench, spread: GeometrySpread) -> FloatArray:
    """Change (36, k) of the parameters in mm with each number of the geometry, by central differences of one sigma.

    A difference as wide as the spread itself: what curvature there is then has the say it has in the spread.
    """
    columns = []
    for k, sigma in enumerate(spread.sigmas):
        if sigma == 0:
            columns.append(np.zeros(PARAMETERS))
            continue
        step = np.zeros(len(spread.names))
        step[k] = sigma
        ends = [bench.solve(bench.geometry(spread.names, sign * step)) for sign in (1.0, -1.0)]
        columns.append((ends[0] - ends[1]) / (2 * sigma))
    return np.stack(columns, axis=1) if columns else np.zeros((PARAMETERS, 0))


def noise_covariance(bench: TrialBench) -> FloatArray:
    """Covariance (36, 36) in mm^2 of the parameters from the noise of the pixels."""
    ideal = Fit(bench.surface, bench.normal, (0.0,), True, 0.0, 0.0, float(bench.t_mm.size))
    return parameter_covariance(ideal, bench.slope_variance())


def geometry_covariance(jacobian: FloatArray, spread: GeometrySpread) -> FloatArray:
    """Covariance (36, 36) in mm^2 of the parameters from the geometry; the live loop adds it to a cycle's own."""
    return np.asarray(jacobian @ spread.covariance @ jacobian.T)


def linear_covariance(benches: Sequence[TrialBench], spread: GeometrySpread) -> FloatArray:
    """What the Monte Carlo finds, without it: (36, 36) in mm^2.

    Parameters
    ----------
    benches : one or two TrialBench
        Of two the covariance is that of the change between them: the geometry is common to both, the noise is not.
    """
    jacobian = geometry_jacobian(benches[0], spread)
    if len(benches) > 1:
        jacobian = jacobian - geometry_jacobian(benches[1], spread)
    noise: FloatArray = np.sum([noise_covariance(bench) for bench in benches], axis=0)
    return geometry_covariance(jacobian, spread) + noise
