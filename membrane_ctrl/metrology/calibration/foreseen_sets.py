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
    """A set whose rays end where the bench found sends them; those that end on the fringes."""
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
    turns = bench_poses.pose_derivatives(solution.problem.stated, solution.values)
    references = solution.problem.references
    return normal_equations.linearise_set(
        solution.bench, turns, phases, state, solution.common, references, robust
    )


def with_equations(solution: Solution, linear: tuple[normal_equations.Equations, ...]) -> Solution:
    sums, sigmas = (
        np.sum([each.eliminate_surface() for each in linear], axis=0),
        solution.problem.sigmas,
    )
    return replace(
        solution,
        equations=linear,
        covariance=solve_step(sums + solution.prior_sums(sigmas), sigmas).covariance,
    )
