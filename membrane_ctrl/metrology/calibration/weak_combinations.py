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

WEAK = 0.5  # sigma after over sigma before, from which on the sets do not determine a combination
_LEAST_PART = 0.3  # of a unit combination: smaller parts are not named
_MOSTLY = 0.8  # share of a change's square that its name must explain
_NOTHING_UM = 0.5  # RMS of a change that a figure does not show


@dataclass(frozen=True)
class Combination:
    """A direction in the space of parameters.

    Attributes
    ----------
    left : float
        Sigma after over sigma before the calibration; 1: the sets determine nothing of it.
    parts : tuple of (str, float)
        Names and amounts of one sigma, in the parameters' units; the largest first.
    height_um : float
        RMS effect of one sigma on the surface.
    figure_um : float
        The same without the best plane.
    words : str
        Name of that effect, for people.
    """

    left: float
    parts: tuple[tuple[str, float], ...]
    height_um: float
    figure_um: float
    words: str


def condition_number(solution: Solution) -> float:
    """Condition number of the free parameters' covariance, in units of the hand measurements'
    sigmas.
    """
    covariance, _ = _scale_covariance(solution)
    values = np.linalg.eigvalsh(covariance)
    return float(values[-1] / values[0])


def weak_combinations(
    solution: Solution, index: int, analysis_radius_mm: float
) -> tuple[Combination, ...]:
    """Combinations that the sets do not determine.

    Parameters
    ----------
    solution : Solution
        The calibration.
    index : int
        Number of the set on whose surface the effects are stated.
    analysis_radius_mm : float
        Radius over which they are averaged.

    Returns
    -------
    tuple of Combination
        The least determined first.
    """
    # In units of the hand measurements, so that an eigenvalue of 1 is a combination about which
    # nothing was learned.
    covariance, free = _scale_covariance(solution)
    values, vectors = np.linalg.eigh(covariance)
    combinations = []
    for value, vector in sorted(zip(values, vectors.T, strict=True), key=lambda pair: -pair[0]):
        if value < WEAK**2:
            break

        # One sigma of the combination, as amounts of its parameters; the large ones are named.
        left = float(np.sqrt(value))
        amounts = vector * np.sqrt(value) * solution.problem.sigmas[free]
        order = [k for k in np.argsort(-np.abs(vector)) if abs(vector[k]) > _LEAST_PART]
        parts = tuple((bench_parameters.NAMES[free[k]], float(amounts[k])) for k in order)
        combinations.append(
            _describe_combination(solution, index, analysis_radius_mm, left, parts, free, amounts)
        )
    return tuple(combinations)


def _scale_covariance(solution: Solution) -> tuple[FloatArray, IntArray]:
    """Covariance (k, k) of the free parameters in units of the hand measurements' sigmas, and their
    numbers (k,).
    """
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
    """The combination with its effect on the surface of a set, and in words.

    `parts` are the parameters that are named; `amounts` (k,) are those of all free parameters,
    whose numbers are `free` (k,).
    """
    # The effect of one sigma on the surface, as heights over the disc with and without their
    # plane. The laser's scale has none.
    is_optical = free < bench_poses.OPTICAL
    response = surface_response(solution, index)[:, free[is_optical]]
    change_mm = response @ amounts[is_optical]
    heights, plane = heights_over_disc(radius_mm / solution.problem.radius_mm)
    moved_um = 1e3 * heights @ change_mm
    figure_um = remove_plane(moved_um, plane)

    # The words: the name of the effect, and the parameters.
    descriptions = []
    for name, amount in parts:
        parameter = bench_parameters.ALL[bench_parameters.NAMES.index(name)]
        descriptions.append(f"{amount:+.2g} {parameter.unit}: {parameter.description}")
    effect = _name_effect(solution, index, moved_um, figure_um, plane)
    words = f"{effect} ({'; '.join(descriptions)})"
    return Combination(
        left=left,
        parts=parts,
        height_um=float(np.sqrt(np.mean(moved_um**2))),
        figure_um=float(np.sqrt(np.mean(figure_um**2))),
        words=words,
    )


def _name_effect(
    solution: Solution, index: int, moved_um: FloatArray, figure_um: FloatArray, plane: FloatArray
) -> str:
    """The name of a change of the surface: a tilt, a scale, a turn about z, or a figure.

    `moved_um` (n,) is the change at points of the disc, `figure_um` (n,) the same without its
    plane, and `plane` (n, 3) are 1, x and y there.
    """
    # Too small to show in a figure, or mostly the plane that its removal takes.
    total = float(np.mean(moved_um**2))
    if total < _NOTHING_UM**2:
        return "nothing that a figure shows"
    figure_rms_um = np.sqrt(np.mean(figure_um**2))
    kept = f"; {figure_rms_um:.2g} µm RMS of figure"
    tilt_share = 1 - float(np.mean(figure_um**2)) / total
    if tilt_share > _MOSTLY:
        slope = np.linalg.lstsq(plane, moved_um, rcond=None)[0][1:]
        return f"a tilt of the surface by {np.hypot(*slope):.2g} µm at the rim{kept}"

    # Changes of height by a scale of the surface, h itself, and by its turn about z,
    # x dh/dy - y dh/dx. A name fits by the share of the square that its best multiple explains.
    x = plane[:, 1]
    y = plane[:, 2]
    parameters = solution.states[index].surface.parameters
    height, by_x, by_y = (part.T @ parameters for part in surface_basis.evaluate_basis(x, y))
    fields = {"a scale of the surface": height, "a turn about z": x * by_y - y * by_x}
    for name, field in fields.items():
        share = (moved_um @ field) ** 2 / (field @ field) / (moved_um @ moved_um)
        if share > _MOSTLY:
            return f"{name}{kept}"
    return f"a change of figure of {figure_rms_um:.2g} µm RMS"
