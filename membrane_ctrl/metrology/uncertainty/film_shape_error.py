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

_SAG_WEIGHT = 1e3  # of the sag, relative to one height
_GRID = 41  # points along the diameter


@cache
def _most_similar_surfaces() -> FloatArray:
    """Parameters (parameters, k) of the surfaces that are most similar to the k terms beyond the
    fit's, and have their sag.
    """
    axis = np.linspace(-1, 1, _GRID)
    x, y = (a.ravel() for a in np.meshgrid(axis, axis))
    inside = np.hypot(x, y) <= 1
    of_parameters = surface_basis.evaluate_basis(x[inside], y[inside])[0].T
    heights = surface_basis.evaluate_beyond_basis(x[inside], y[inside])[0]

    # Sags of the terms beyond; the mean of a wave over the rim is 0.
    sags = surface_basis.evaluate_beyond_basis(np.ones(1), np.zeros(1))[0]
    sags[terms_beyond_fit.WAVE] = 0.0

    # Least squares for heights and sag.
    table = np.vstack([of_parameters, _SAG_WEIGHT * sag_gradient()])
    wanted = np.vstack([heights.T, _SAG_WEIGHT * sags.T])
    return np.asarray(np.linalg.lstsq(table, wanted, rcond=None)[0])


def law_effect(
    patches: residual_patches.Patches,
    radius_mm: float,
    inverse: FloatArray,
    slope_variance: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Errors of the parameters for a film that is not Hencky's, as its residual slopes show it.

    Pre-strain, another Poisson ratio or a ring's moment bend the round profile beyond the terms and
    the excess; an orthotropic film or a ring that is not flat adds waves. Least squares assign some
    of that to other terms, and the rest is missing from the sag.

    Parameters
    ----------
    patches : Patches
        Residual slopes of the fit.
    radius_mm : float
        Radius of the Zernike disc.
    inverse : (parameters, parameters) array
        Inverse of the fit's normal matrix.
    slope_variance : float
        Variance of a point's slope from noise.

    Returns
    -------
    effects_mm : (parameters, 2) array
        Errors by the round profile, and by waves.
    noise_mm2 : (2,) array
        What the noise adds to the sums of their squares.
    """
    x, y = patches.places_mm / radius_mm
    _, *slopes = surface_basis.evaluate_basis(x, y)
    _, *beyond_slopes = surface_basis.evaluate_beyond_basis(x, y)
    pairs = list(zip(slopes, beyond_slopes, strict=True))

    # Parameters that the fit takes for each term beyond, less those that are right.
    products = sum((own * patches.count) @ beyond.T for own, beyond in pairs)
    absorbed = inverse @ products / radius_mm**2
    error = absorbed - _most_similar_surfaces()

    # Slopes that the fit leaves of each term beyond, and those that it left of the film, weighted.
    left = np.hstack([beyond - absorbed.T @ own for own, beyond in pairs]).T
    weights = np.sqrt(np.tile(patches.count, 2))
    left = left * weights[:, None] / radius_mm
    seen = patches.slopes.ravel() * weights

    # Amplitudes of the terms from the slopes, by least squares. The round profile is free; waves
    # have the prior of a film that was never measured.
    round_left = left[:, terms_beyond_fit.ROUND]
    wave_left = left[:, terms_beyond_fit.WAVE]
    scatter = max(float(np.mean(seen**2)), slope_variance)
    sigmas_mm = np.array([wave.sigma_mm for wave in terms_beyond_fit.WAVES])
    waves = wave_left.T @ wave_left + scatter * np.diag(1 / sigmas_mm**2)
    answers = (
        error[:, terms_beyond_fit.ROUND] @ np.linalg.pinv(round_left),
        error[:, terms_beyond_fit.WAVE] @ np.linalg.solve(waves, wave_left.T),
    )
    effects_mm = np.stack([answer @ seen for answer in answers], axis=1)
    noise = np.array([float(np.sum(answer**2)) for answer in answers])
    return effects_mm, slope_variance * noise


def film_shape_sources(full: FullResult, slope_variance: FloatArray) -> tuple[budget.Source, ...]:
    """Rows of the budget for the film's round profile and for its waves.

    `slope_variance` (2,) is that of an x and of a y slope from the noise.
    """
    patches = residual_patches.Patches.of_grid(full.fit_grid)
    variance = float(slope_variance.mean())
    effects_mm, noise_mm2 = law_effect(
        patches, full.surface.radius_mm, full.fit.normal.inverse, variance
    )
    rows = (
        ("film_law", "film that is not Hencky's: round slopes that no term explains"),
        ("film_waves", "film or ring that is not even: waves that no term explains"),
    )
    sources = []
    for k, (name, says) in enumerate(rows):
        effect_mm = effects_mm[:, [k]]
        noise = float(noise_mm2[k])
        source = budget.Source(name, says, math.nan, effect_mm, common=False, noise_mm2=noise)
        sources.append(source)
    return tuple(sources)
