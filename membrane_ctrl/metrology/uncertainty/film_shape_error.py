"""Error of the parameters for a film whose bowl is not Hencky's, as its residual slopes show it."""

import math
from functools import cache

import numpy as np

from membrane_ctrl.metrology.figure.pixel_figure import FullResult
from membrane_ctrl.metrology.rays import surface_basis
from membrane_ctrl.metrology.rays.surface import sag_gradient
from membrane_ctrl.metrology.uncertainty import budget, residual_patches
from membrane_ctrl.model.arrays import FloatArray

_HEAVY = 1e3  # weight of the sag beside the heights


@cache
def _most_similar_surfaces() -> FloatArray:
    """(parameters, k) parameters of the surfaces most like the round terms beyond the fit's, with
    their sag.
    """
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-1, 1, 41)] * 2))
    inside = np.hypot(x, y) <= 1
    rows, (heights, _, _) = (
        surface_basis.evaluate_basis(x[inside], y[inside])[0].T,
        surface_basis.evaluate_round_basis(x[inside], y[inside]),
    )
    rim = surface_basis.evaluate_round_basis(np.ones(1), np.zeros(1))[0]
    table = np.vstack([rows, _HEAVY * sag_gradient()])
    return np.asarray(np.linalg.lstsq(table, np.vstack([heights.T, _HEAVY * rim.T]), rcond=None)[0])


def law_effect(
    patches: residual_patches.Patches,
    radius_mm: float,
    inverse: FloatArray,
    slope_variance: float = 0.0,
) -> tuple[FloatArray, float]:
    """(parameters,) error of the parameters, in mm, for a film whose bowl is not Hencky's, as its
    residual slopes show it.

    The second answer is what noise of the points' slopes adds to its square.

    Pre-strain, another Poisson ratio or a ring's moment bend the round profile beyond the terms and
    the excess. Least squares take some of that for other terms, and the rest is missing from the
    sag.
    """
    x, y = patches.places_mm / radius_mm
    _, *of = surface_basis.evaluate_basis(x, y)
    _, *beyond = surface_basis.evaluate_round_basis(x, y)
    absorbed = (
        inverse
        @ sum((a * patches.count) @ b.T for a, b in zip(of, beyond, strict=True))
        / radius_mm**2
    )
    left = np.hstack([b - absorbed.T @ a for a, b in zip(of, beyond, strict=True)]).T
    weights = np.sqrt(np.tile(patches.count, 2))
    answer = (
        (absorbed - _most_similar_surfaces()) @ np.linalg.pinv(left * weights[:, None]) * radius_mm
    )
    return answer @ (patches.slopes.ravel() * weights), slope_variance * float(np.sum(answer**2))


def film_shape_source(full: FullResult, slope_variance: FloatArray) -> budget.Source:
    patches, variance = (
        residual_patches.Patches.of_grid(full.fit_grid),
        float(slope_variance.mean()),
    )
    effect, noise = law_effect(patches, full.surface.radius_mm, full.fit.normal.inverse, variance)
    says = "film that is not Hencky's: round slopes that no term explains"
    return budget.Source("film_law", says, math.nan, effect[:, None], common=False, noise_mm2=noise)
