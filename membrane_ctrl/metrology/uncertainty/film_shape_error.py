"""Error of the parameters for a film that is not Hencky's, as its residual slopes show it.

Its bowl may have another round profile, and waves around the azimuth if its moduli differ with
direction or its ring is not flat.
"""

import math
from functools import cache

import numpy as np

from membrane_ctrl.metrology.figure.pixel_figure import FullResult
from membrane_ctrl.metrology.film import terms_beyond_fit
from membrane_ctrl.metrology.rays import surface_basis
from membrane_ctrl.metrology.rays.surface import sag_gradient
from membrane_ctrl.metrology.uncertainty import budget, residual_patches
from membrane_ctrl.model.arrays import FloatArray

_HEAVY = 1e3  # weight of the sag beside the heights


@cache
def _most_similar_surfaces() -> FloatArray:
    """(parameters, k) parameters of the surfaces most like the terms beyond the fit's, with their
    sag.
    """
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-1, 1, 41)] * 2))
    inside = np.hypot(x, y) <= 1
    rows, (heights, _, _) = (
        surface_basis.evaluate_basis(x[inside], y[inside])[0].T,
        surface_basis.evaluate_beyond_basis(x[inside], y[inside]),
    )
    rim = surface_basis.evaluate_beyond_basis(np.ones(1), np.zeros(1))[0]
    rim[terms_beyond_fit.WAVE] = 0.0  # their mean over the rim
    table = np.vstack([rows, _HEAVY * sag_gradient()])
    return np.asarray(np.linalg.lstsq(table, np.vstack([heights.T, _HEAVY * rim.T]), rcond=None)[0])


def law_effect(
    patches: residual_patches.Patches,
    radius_mm: float,
    inverse: FloatArray,
    slope_variance: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """(parameters, 2) errors of the parameters, in mm, for a film that is not Hencky's, as its
    residual slopes show it: by its round profile, and by waves.

    The second answer (2,) is what noise of the points' slopes adds to their squares.

    Pre-strain, another Poisson ratio or a ring's moment bend the round profile beyond the terms and
    the excess; an orthotropic film or a ring that is not flat adds waves. Least squares take some
    of that for other terms, and the rest is missing from the sag.
    """
    x, y = patches.places_mm / radius_mm
    _, *of = surface_basis.evaluate_basis(x, y)
    _, *beyond = surface_basis.evaluate_beyond_basis(x, y)
    absorbed = (
        inverse
        @ sum((a * patches.count) @ b.T for a, b in zip(of, beyond, strict=True))
        / radius_mm**2
    )
    error = absorbed - _most_similar_surfaces()
    left = np.hstack([b - absorbed.T @ a for a, b in zip(of, beyond, strict=True)]).T
    weights = np.sqrt(np.tile(patches.count, 2))
    left = left * weights[:, None] / radius_mm
    seen = patches.slopes.ravel() * weights
    # Any round profile; waves are as large as in films that nobody has measured.
    round_left, wave_left = left[:, terms_beyond_fit.ROUND], left[:, terms_beyond_fit.WAVE]
    scatter = max(float(np.mean(seen**2)), slope_variance)
    sigmas_mm = np.array([wave.sigma_mm for wave in terms_beyond_fit.WAVES])
    waves = wave_left.T @ wave_left + scatter * np.diag(1 / sigmas_mm**2)
    answers = (
        error[:, terms_beyond_fit.ROUND] @ np.linalg.pinv(round_left),
        error[:, terms_beyond_fit.WAVE] @ np.linalg.solve(waves, wave_left.T),
    )
    effects = np.stack([answer @ seen for answer in answers], axis=1)
    noise = np.array([float(np.sum(answer**2)) for answer in answers])
    return effects, slope_variance * noise


def film_shape_sources(full: FullResult, slope_variance: FloatArray) -> tuple[budget.Source, ...]:
    """The rows of the film's round profile and of its waves."""
    patches, variance = (
        residual_patches.Patches.of_grid(full.fit_grid),
        float(slope_variance.mean()),
    )
    effects, noise = law_effect(patches, full.surface.radius_mm, full.fit.normal.inverse, variance)
    rows = (
        ("film_law", "film that is not Hencky's: round slopes that no term explains"),
        ("film_waves", "film or ring that is not even: waves that no term explains"),
    )
    return tuple(
        budget.Source(
            name, says, math.nan, effects[:, [k]], common=False, noise_mm2=float(noise[k])
        )
        for k, (name, says) in enumerate(rows)
    )
