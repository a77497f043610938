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
    """The one hand measurement that would lower the sag's sigma most."""

    name: str
    sigma: float  # to which it should be known
    sag_um: float  # 1 sigma then


def advise_number(solution: Solution, index: int) -> Advice | None:
    """What to measure better, from the equations alone; None if no single number is worth it."""
    sums, own = (
        np.sum([each.reduced() for each in solution.equations], axis=0),
        solution.problem.sigmas,
    )
    found = []
    for k in np.flatnonzero(own > 0):
        better = own.copy()
        better[k] /= _BETTER
        moved = replace(
            solution, covariance=solve_step(sums + solution.known(better), better).covariance
        )
        found.append(
            Advice(
                bench_parameters.NAMES[k],
                float(better[k]),
                sag_um(surface_covariance(moved, index)),
            )
        )
    best = min(found, key=lambda each: each.sag_um, default=None)
    return (
        best
        if best is not None
        and best.sag_um < WORTHWHILE_SHARE * sag_um(surface_covariance(solution, index))
        else None
    )
