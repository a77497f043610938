"""Combinations of parameters that the sets do not determine, and their effect on a figure, in
words.

In units of the hand measurements' sigmas, the covariance has eigenvalues between 0 (the sets know
far better) and 1 (they know nothing). A combination near 1 is named by its largest parts and by
the effect of one sigma on the surface.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.calibration.figure_uncertainty import surface_response
from membrane_ctrl.metrology.calibration.solver import Solution
from membrane_ctrl.metrology.rays import bench_parameters, bench_poses, surface_basis
from membrane_ctrl.metrology.rays.disc_heights import heights_over_disc, remove_plane
from membrane_ctrl.model.arrays import FloatArray, IntArray

WEAK = 0.5  # of the hand's sigma: the sets have not even doubled the knowledge
_PART = 0.3  # of a unit combination: smaller parts are not named
_MOSTLY = 0.8  # share of a change's square that its name must explain
_NOTHING_UM = 0.5


@dataclass(frozen=True)
class Combination:
    """A direction in the space of parameters."""

    left: float  # sigma after over sigma before; 1: the sets say nothing
    parts: tuple[
        tuple[str, float], ...
    ]  # of one sigma, in the parameters' units, the largest first
    height_um: float  # effect of one sigma on the surface, RMS, and without the best plane
    figure_um: float
    words: str  # name of that effect


def condition_number(solution: Solution) -> float:
    """Of the free parameters' covariance in units of the hand measurements' sigmas."""
    values = np.linalg.eigvalsh(_scale_covariance(solution)[0])
    return float(values[-1] / values[0])


def weak_combinations(
    solution: Solution, index: int, analysis_radius_mm: float
) -> tuple[Combination, ...]:
    """Combinations that the sets leave undetermined, the worst first; `index` is the set whose
    surface shows it.
    """
    covariance, free = _scale_covariance(solution)
    values, vectors = np.linalg.eigh(covariance)
    out = []
    for value, vector in sorted(zip(values, vectors.T, strict=True), key=lambda pair: -pair[0]):
        if value < WEAK**2:
            break
        amounts = vector * np.sqrt(value) * solution.problem.sigmas[free]
        order = np.argsort(-np.abs(vector))
        parts = tuple(
            (bench_parameters.NAMES[free[k]], float(amounts[k]))
            for k in order
            if abs(vector[k]) > _PART
        )
        out.append(
            _describe_combination(
                solution, index, analysis_radius_mm, float(np.sqrt(value)), parts, free, amounts
            )
        )
    return tuple(out)


def _scale_covariance(solution: Solution) -> tuple[FloatArray, IntArray]:
    free = np.flatnonzero(solution.problem.sigmas > 0)
    scale = solution.problem.sigmas[free]
    return solution.covariance[np.ix_(free, free)] / np.outer(scale, scale), free


def _describe_combination(
    solution: Solution,
    index: int,
    radius_mm: float,
    left: float,
    parts: tuple[tuple[str, float], ...],
    free: IntArray,
    amounts: FloatArray,
) -> Combination:
    optical = free < bench_poses.OPTICAL
    change = surface_response(solution, index)[:, free[optical]] @ amounts[optical]
    heights, plane = heights_over_disc(radius_mm / solution.problem.radius_mm)
    moved_um = 1e3 * heights @ change
    figure_um = remove_plane(moved_um, plane)
    height, figure = (float(np.sqrt(np.mean(part**2))) for part in (moved_um, figure_um))
    named = [
        (bench_parameters.ALL[bench_parameters.NAMES.index(name)], amount) for name, amount in parts
    ]
    says = "; ".join(
        f"{amount:+.2g} {parameter.unit}: {parameter.says}" for parameter, amount in named
    )
    effect = _name_effect(solution, index, moved_um, figure_um, plane)
    return Combination(left, parts, height, figure, f"{effect} ({says})")


def _name_effect(
    solution: Solution, index: int, moved_um: FloatArray, figure_um: FloatArray, plane: FloatArray
) -> str:
    """The name of a change of the surface: one of the motions of a rigid body, a scale, or a
    figure.
    """
    total = float(np.mean(moved_um**2))
    if total < _NOTHING_UM**2:
        return "nothing that a figure shows"
    kept = f"; {np.sqrt(np.mean(figure_um**2)):.2g} µm RMS of figure"
    if 1 - float(np.mean(figure_um**2)) / total > _MOSTLY:
        slope = np.linalg.lstsq(plane, moved_um, rcond=None)[0][1:]
        return f"a tilt of the surface by {np.hypot(*slope):.2g} µm at the rim{kept}"
    x, y = plane[:, 1], plane[:, 2]
    surface = solution.states[index].surface.parameters
    height, by_x, by_y = (part.T @ surface for part in surface_basis.evaluate_basis(x, y))
    for name, field in (
        ("a scale of the surface", height),
        ("a turn about z", x * by_y - y * by_x),
    ):
        share = (moved_um @ field) ** 2 / (field @ field) / (moved_um @ moved_um)
        if share > _MOSTLY:
            return f"{name}{kept}"
    return f"a change of figure of {np.sqrt(np.mean(figure_um**2)):.2g} µm RMS"
