"""Sets that are not taken yet, foreseen on the bench found.

Their rays are followed to where they would end, with the noise of the film's set, and their normal
equations are added. No prediction needs a measured value.
"""

from dataclasses import replace

import numpy as np

from membrane_ctrl.metrology.calibration import normal_equations, robust_weights, set_state
from membrane_ctrl.metrology.calibration.solver import Solution, solve_step
from membrane_ctrl.metrology.rays import bench_poses, forward_model, set_phases
from membrane_ctrl.model.arrays import FloatArray


def foreseen_set(
    solution: Solution,
    phases: set_phases.SetPhases,
    state: set_state.SetState,
    half_mm: FloatArray,
) -> set_phases.SetPhases:
    """Return a set whose rays end where the bench found sends them.

    Parameters
    ----------
    solution : Solution
        Its bench.
    phases : SetPhases
        Bins of the set; their screen points are replaced.
    state : SetState
        Surface, vertex and screens of the set.
    half_mm : (2,) array
        Half of the pattern's width and height.

    Returns
    -------
    SetPhases
        The bins whose rays end on the pattern.
    """
    dark = replace(phases, screen_mm=np.zeros_like(phases.screen_mm))
    at_mm = -forward_model.residual_mm(
        solution.bench, dark, state.surface, state.vertex_z_mm, state.moved_screens
    )
    return replace(phases, screen_mm=at_mm).subset(
        np.asarray(np.all(np.abs(at_mm) < half_mm[:, None], axis=0))
    )


def foreseen_equations(
    solution: Solution,
    phases: set_phases.SetPhases,
    state: set_state.SetState,
    robust: robust_weights.RobustWeights,
) -> normal_equations.Equations:
    """Return the equations of a foreseen set about the solution.

    Parameters
    ----------
    solution : Solution
        The unknowns about which is linearised.
    phases : SetPhases
        The set.
    state : SetState
        Its own unknowns.
    robust : RobustWeights
        Weights of its points.

    Returns
    -------
    Equations
    """
    turns = bench_poses.pose_derivatives(solution.problem.stated, solution.values)
    references = solution.problem.references
    return normal_equations.linearise_set(
        solution.bench, turns, phases, state, solution.common, references, robust
    )


def with_equations(solution: Solution, linear: tuple[normal_equations.Equations, ...]) -> Solution:
    """Return the solution with the covariance that other sets would give it.

    Parameters
    ----------
    solution : Solution
        Its unknowns stay.
    linear : tuple of Equations
        Equations of all sets, foreseen ones among them.
    """
    sigmas = solution.problem.sigmas
    of_sets = np.sum([each.eliminate_surface() for each in linear], axis=0)
    step = solve_step(of_sets + solution.prior_sums(sigmas), sigmas)
    return replace(solution, equations=linear, covariance=step.covariance)
