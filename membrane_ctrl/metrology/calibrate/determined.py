"""Which combinations of parameters the sets do not determine, and what a figure has of that, in words.

In units of what was known by hand, the covariance has eigenvalues between 0 (the sets know far better) and 1 (they
know nothing). A combination near 1 is named by its largest parts and by what one sigma of it does to the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.calibrate.parameters import ALL, NAMES, OPTICAL
from membrane_ctrl.metrology.calibrate.propagate import disc, surface_response
from membrane_ctrl.metrology.calibrate.residuals import basis
from membrane_ctrl.metrology.calibrate.solve import Solution

FloatArray = NDArray[np.float64]

WEAK = 0.5  # of the hand's sigma: the sets have not even doubled the knowledge
_PART = 0.3  # of a unit combination: smaller parts are not named
_MOSTLY = 0.8  # share of a change's square that its name must explain
_NOTHING_UM = 0.5


@dataclass(frozen=True)
class Combination:
    """A direction in the space of parameters.

    Attributes
    ----------
    left : float
        Sigma after over sigma before; 1: the sets say nothing.
    parts : tuple of (name, amount)
        Of one sigma, in the parameters' units, the largest first.
    height_um, figure_um : float
        What one sigma of it does to the surface, RMS, and without the best plane.
    words : str
        What that is.
    """

    left: float
    parts: tuple[tuple[str, float], ...]
    height_um: float
    figure_um: float
    words: str


def condition_number(solution: Solution) -> float:
    """Of the free parameters' covariance in units of what was known by hand."""
    values = np.linalg.eigvalsh(_scaled(solution)[0])
    return float(values[-1] / values[0])


def weak_combinations(solution: Solution, index: int, analysis_radius_mm: float) -> tuple[Combination, ...]:
    """Combinations that the sets leave undetermined, the worst first; `index` is the set whose surface shows it."""
    covariance, free = _scaled(solution)
    values, vectors = np.linalg.eigh(covariance)
    out = []
    for value, vector in sorted(zip(values, vectors.T, strict=True), key=lambda pair: -pair[0]):
        if value < WEAK**2:
            break
        amounts = vector * np.sqrt(value) * solution.problem.sigmas[free]
        order = np.argsort(-np.abs(vector))
        parts = tuple((NAMES[free[k]], float(amounts[k])) for k in order if abs(vector[k]) > _PART)
        out.append(_described(solution, index, analysis_radius_mm, float(np.sqrt(value)), parts, free, amounts))
    return tuple(out)


def _scaled(solution: Solution) -> tuple[FloatArray, NDArray[np.int64]]:
    free = np.flatnonzero(solution.problem.sigmas > 0)
    scale = solution.problem.sigmas[free]
    return solution.covariance[np.ix_(free, free)] / np.outer(scale, scale), free


def _described(
    solution: Solution,
    index: int,
    radius_mm: float,
    left: float,
    parts: tuple[tuple[str, float], ...],
    free: NDArray[np.int64],
    amounts: FloatArray,
) -> Combination:
    optical = free < OPTICAL
    change = surface_response(solution, index)[:, free[optical]] @ amounts[optical]
    heights, plane = disc(radius_mm / solution.problem.radius_mm)
    moved_um = 1e3 * heights @ change
    figure_um = moved_um - plane @ np.linalg.lstsq(plane, moved_um, rcond=None)[0]
    height, figure = (float(np.sqrt(np.mean(part**2))) for part in (moved_um, figure_um))
    says = "; ".join(f"{amount:+.2g} {_unit(name)}: {_says(name)}" for name, amount in parts)
    effect = _effect(solution, index, moved_um, figure_um, plane)
    return Combination(left, parts, height, figure, f"{effect} ({says})")


def _effect(solution: Solution, index: int, moved_um: FloatArray, figure_um: FloatArray, plane: FloatArray) -> str:
    """The name of a change of the surface: one of the motions of a rigid body, a scale, or a figure."""
    total = float(np.mean(moved_um**2))
    if total < _NOTHING_UM**2:
        return "nothing that a figure shows"
    kept = f"; {np.sqrt(np.mean(figure_um**2)):.2g} um RMS of figure"
    if 1 - float(np.mean(figure_um**2)) / total > _MOSTLY:
        return f"a tilt of the surface by {np.hypot(*plane_slope(plane, moved_um)):.2g} um at the rim{kept}"
    x, y = plane[:, 1], plane[:, 2]
    surface = solution.states[index].surface.parameters
    height, by_x, by_y = (part.T @ surface for part in basis(x, y))
    for name, field in (("a scale of the surface", height), ("a turn about z", x * by_y - y * by_x)):
        share = (moved_um @ field) ** 2 / (field @ field) / (moved_um @ moved_um)
        if share > _MOSTLY:
            return f"{name}{kept}"
    return f"a change of figure of {np.sqrt(np.mean(figure_um**2)):.2g} um RMS"


def plane_slope(plane: FloatArray, heights: FloatArray) -> FloatArray:
    """x and y slope of the best plane, per radius."""
    return np.asarray(np.linalg.lstsq(plane, heights, rcond=None)[0][1:])


def _unit(name: str) -> str:
    return ALL[NAMES.index(name)].unit


def _says(name: str) -> str:
    return ALL[NAMES.index(name)].says
