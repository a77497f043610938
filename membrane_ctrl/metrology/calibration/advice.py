"""The hand measurement that would lower the sag's sigma most."""

from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.calibration.figure_uncertainty import sag_um, surface_covariance
from membrane_ctrl.metrology.calibration.solver import Solution, solve_step
from membrane_ctrl.metrology.rays import bench_parameters

_BETTER = 5.0  # times: what another instrument may give
WORTHWHILE_SHARE = 0.9  # of the sag's sigma: less of a gain is not worth the trouble


@dataclass(frozen=True)
class Advice:
    """The one hand measurement that would lower the sag's sigma most.

    Attributes
    ----------
    name : str
        Of the parameter.
    sigma : float
        Standard uncertainty to which it should be known.
    sag_um : float
        1 sigma of the sag then.
    """

    name: str
    sigma: float
    sag_um: float


def advise_number(solution: Solution, index: int) -> Advice | None:
    """What to measure better, from the equations alone; None if no single number is worth it.

    Parameters
    ----------
    solution : Solution
        The calibration.
    index : int
        Number of the set whose sag is considered.
    """
    # The sag's sigma with each free parameter in turn known better. The covariance follows from the
    # same equations with another prior: no residual is computed again.
    sums = np.sum([each.eliminate_surface() for each in solution.equations], axis=0)
    sigmas = solution.problem.sigmas
    advice = []
    for k in np.flatnonzero(sigmas > 0):
        better = sigmas.copy()
        better[k] /= _BETTER
        step = solve_step(sums + solution.prior_sums(better), better)
        improved = replace(solution, covariance=step.covariance)
        sag_then_um = sag_um(surface_covariance(improved, index))
        advice.append(Advice(bench_parameters.NAMES[k], float(better[k]), sag_then_um))

    # The best of them, if it lowers the sigma enough.
    best = min(advice, key=lambda each: each.sag_um, default=None)
    present_um = sag_um(surface_covariance(solution, index))
    if best is None or best.sag_um >= WORTHWHILE_SHARE * present_um:
        return None
    return best
