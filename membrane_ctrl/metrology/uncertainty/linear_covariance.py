"""The linear covariance of the parameters, to compare with the Monte Carlo: C = J S J^T + C_noise.

S is the covariance of the geometry and J the change of the parameters with it, from two solutions
for each number (some ms each). J hardly changes while the film moves by micrometres, so the live
cycle computes it once.
"""

from collections.abc import Sequence

import numpy as np

from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.metrology.reconstruction import slope_noise
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.model.arrays import FloatArray


def geometry_jacobian(bench: TrialBench, spread: GeometrySpread) -> FloatArray:
    """Derivatives of the surface's parameters by the numbers of the geometry.

    Central differences of one sigma: they are as wide as the spread itself, so that curvature
    counts as it does in the spread.

    Parameters
    ----------
    bench : TrialBench
        A thinned set.
    spread : GeometrySpread
        k numbers and their sigmas.

    Returns
    -------
    (parameters, k) array
        In mm per unit of the number.
    """
    columns = []
    for k, sigma in enumerate(spread.sigmas):
        if sigma == 0:
            columns.append(np.zeros(PARAMETERS))
            continue
        # The surface solved on benches that are one sigma off to either side.
        step = np.zeros(len(spread.names))
        step[k] = sigma
        above = bench.solve(bench.geometry(spread.names, step), linear=True)
        below = bench.solve(bench.geometry(spread.names, -step), linear=True)
        columns.append((above - below) / (2 * sigma))
    if not columns:
        return np.zeros((PARAMETERS, 0))
    return np.stack(columns, axis=1)


def noise_covariance(bench: TrialBench) -> FloatArray:
    """Covariance (parameters, parameters) in mm^2 from the noise of the pixels."""
    return slope_noise.parameter_covariance(bench.normal, bench.slope_variance())


def geometry_covariance(jacobian: FloatArray, spread: GeometrySpread) -> FloatArray:
    """Covariance of the surface's parameters from the geometry, J S J^T.

    Parameters
    ----------
    jacobian : (parameters, k) array
        Of `geometry_jacobian`.
    spread : GeometrySpread
        S, of the same k numbers.

    Returns
    -------
    (parameters, parameters) array
        In mm^2.
    """
    return np.asarray(jacobian @ spread.covariance @ jacobian.T)


def linear_covariance(benches: Sequence[TrialBench], spread: GeometrySpread) -> FloatArray:
    """Covariance that the Monte Carlo approximates (eq. 2 of docs/explanation/uncertainty.md).

    Parameters
    ----------
    benches : sequence of one or two TrialBench
        A set, or two sets whose change is asked for: they share the geometry, not the noise.
    spread : GeometrySpread
        Covariance of the geometry.

    Returns
    -------
    (parameters, parameters) array
        In mm^2.
    """
    jacobian = geometry_jacobian(benches[0], spread)
    if len(benches) > 1:
        jacobian = jacobian - geometry_jacobian(benches[1], spread)
    noise: FloatArray = np.sum([noise_covariance(bench) for bench in benches], axis=0)
    return geometry_covariance(jacobian, spread) + noise
