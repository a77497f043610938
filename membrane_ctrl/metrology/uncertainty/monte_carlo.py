"""Monte Carlo over geometry and pixel noise (the paper's section 3.1), on a few thousand bins.

A trial of the paper disturbs the frames of every pixel and reconstructs them again. The disturbance
of a bin's phase by white noise of the pixels is known: sigma sqrt(2 / N) / (B m) for bins of m x m
pixels. A few thousand of the bins determine the terms: one in k, each with a k-th of the variance,
gives the fit the same covariance as all of them. A trial therefore draws a geometry, disturbs the
screen points that the fitted surface predicts, and takes the two or three Gauss-Newton steps from
the fitted surface to the disturbed one.

Seeds: the geometry of trial t comes from (seed, 0, t), the noise of set s in it from (seed, 1 + s,
t): independent of the order, of the number of workers and of what else is in the run, and the
geometry is common to all sets.
"""

from collections.abc import Sequence

import numpy as np

from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.model.arrays import FloatArray


def run_trials(
    benches: Sequence[TrialBench],
    spread: GeometrySpread,
    seed: int,
    trials: Sequence[int],
    first_set: int = 0,
) -> FloatArray:
    """Run trials; all sets share the geometry of a trial.

    Parameters
    ----------
    benches : sequence of TrialBench
        One for each set, all with the same nominal geometry.
    spread : GeometrySpread
        From which the geometries are drawn.
    seed : int
        Seed of the run.
    trials : sequence of int
        Numbers of the trials to run.
    first_set : int
        Number of the first set in its run: noise differs from set to set.

    Returns
    -------
    (trials, sets, parameters) array
        Parameters of the surfaces, mm.
    """
    out = np.empty((len(trials), len(benches), PARAMETERS))
    for row, trial in enumerate(trials):
        change = spread.draw_change(np.random.default_rng((seed, 0, trial)))
        for k, bench in enumerate(benches):
            random = np.random.default_rng((seed, 1 + first_set + k, trial))
            noise_mm = random.standard_normal(bench.sigma_mm.shape) * bench.sigma_mm
            out[row, k] = bench.solve(bench.geometry(spread.names, change), noise_mm)
    return out


def trial_covariance(parameters: FloatArray) -> FloatArray:
    """Covariance (parameters, parameters) over trials (trials, parameters)."""
    return np.atleast_2d(np.cov(parameters, rowvar=False))
