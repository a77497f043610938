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
from membrane_ctrl.metrology.uncertainty.round_slopes import RoundSlopes
from membrane_ctrl.model.arrays import FloatArray

_SAG_WEIGHT = 1e3  # of the sag, relative to one height
_GRID = 41  # points along the diameter
# Points of a patch over the usual number, below which its slopes are a selection.
_LEAST_COUNT = 0.3
_RINGS = 20  # of patches, whose slopes scatter equally
_TINY = 1e-30  # instead of a division by zero
# Points of a ring at which the mean of a smooth slope is computed.
_AZIMUTHS = 24
_RADII = 4


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


def round_effect(
    patches: residual_patches.Patches,
    rings: RoundSlopes,
    radius_mm: float,
    inverse: FloatArray,
    slope_variance: float = 0.0,
) -> tuple[FloatArray, float]:
    """Errors of the parameters for a film with another round profile, by its residual slopes.

    Pre-strain, another Poisson ratio or a ring's moment bend the round profile beyond the terms and
    the excess. Least squares take some of that for other terms, and the rest is missing from the
    sag.

    Parameters
    ----------
    patches : Patches
        Where the fit has its points, which decides what the terms take.
    rings : RoundSlopes
        The round part of the residual slopes.
    radius_mm : float
        Of the terms' disc.
    inverse : (parameters, parameters) array
        Of the fit's normal matrix.
    slope_variance : float
        Of the noise of a point's slope.

    Returns
    -------
    (parameters, 2) array
        In mm: the error that the rings show, and 1 sigma of it in the direction of the sag.
    float
        Sum of squares that noise of the points' slopes alone would give these, mm^2.
    """
    absorbed = _absorbed_terms(patches, radius_mm, inverse)[:, terms_beyond_fit.ROUND]
    error = absorbed - _most_similar_surfaces()[:, terms_beyond_fit.ROUND]

    # What each round term leaves of the rings' slopes, and from the slopes back to the terms.
    left = _mean_of_rings(rings, absorbed, radius_mm)
    noise = np.sqrt(slope_variance * rings.share)
    sigma = np.maximum(np.maximum(rings.sigma, noise), 1e-12)
    terms_of_slopes = np.linalg.pinv(left / sigma[:, None]) / sigma * radius_mm
    answer = error @ terms_of_slopes

    # Effect of the slopes that are seen, and its covariance by noise and by scatter.
    seen_mm = answer @ rings.slope
    by_noise = (answer * noise**2) @ answer.T
    by_scatter = (answer * sigma**2) @ answer.T
    square_of_seen = float(np.trace(by_noise))
    square_of_sag = float(np.sum(_along_sag(by_noise) ** 2))
    effects_mm = np.column_stack([seen_mm, _along_sag(by_scatter)])
    return effects_mm, square_of_seen + square_of_sag


def wave_effect(
    patches: residual_patches.Patches,
    radius_mm: float,
    inverse: FloatArray,
    slope_variance: float = 0.0,
) -> tuple[FloatArray, float]:
    """Errors of the parameters for a film with waves, by its residual slopes.

    An orthotropic film or a ring that is not flat adds waves. Their prior is that of a film that
    was never measured.

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
    effects_mm : (parameters, 1 + waves) array
        The error that the slopes show, and 1 sigma of what they do not: where wrinkles at the rim
        or light scatter the slopes, or hide a part of the mirror, the waves' prior is left.
    noise_mm2 : float
        What the noise adds to the sum of its squares.
    """
    x, y = patches.places_mm / radius_mm
    _, *slopes = surface_basis.evaluate_basis(x, y)
    _, *beyond_slopes = surface_basis.evaluate_beyond_basis(x, y)
    pairs = list(zip(slopes, beyond_slopes, strict=True))

    # Parameters that the fit takes for each term beyond, less those that are right.
    absorbed = _absorbed_terms(patches, radius_mm, inverse)
    error = absorbed - _most_similar_surfaces()

    # Slopes that the fit leaves of each term beyond, and those that it left of the film, weighted.
    # Where most slopes of a patch were left out, those that remain are a selection: wrinkles at the
    # rim of one direction alone.
    usual = float(np.median(patches.count[patches.count > 0]))
    count = np.where(patches.count > _LEAST_COUNT * usual, patches.count, 0.0)
    variance = np.maximum(_variance_by_ring(patches, count), max(slope_variance, _TINY))
    weights = np.sqrt(np.tile(count / variance, 2))
    left = np.hstack([beyond - absorbed.T @ own for own, beyond in pairs]).T
    wave_left = (left * weights[:, None] / radius_mm)[:, terms_beyond_fit.WAVE]
    seen = patches.slopes.ravel() * weights

    # The selection has pulled the fit: in the other patches the surface is free.
    span, _ = np.linalg.qr(np.hstack(slopes).T * weights[:, None])
    wave_left = wave_left - span @ (span.T @ wave_left)
    seen = seen - span @ (span.T @ seen)

    # Amplitudes of the waves from the slopes, by least squares with their prior; then the error of
    # the parameters from the amplitudes.
    used = int(np.count_nonzero(count))
    scatter = max(float(np.sum(seen**2)) / max(2 * used, 1), _TINY)
    sigmas_mm = np.array([wave.sigma_mm for wave in terms_beyond_fit.WAVES])
    normal = wave_left.T @ wave_left + scatter * np.diag(1 / sigmas_mm**2)
    amplitudes_of_slopes = np.linalg.solve(normal, wave_left.T)
    error_of_waves = error[:, terms_beyond_fit.WAVE]
    answer = error_of_waves @ amplitudes_of_slopes

    # The amplitudes' covariance after these least squares.
    unknown = error_of_waves @ np.linalg.cholesky(scatter * np.linalg.inv(normal))
    effects_mm = np.column_stack([answer @ seen, unknown])
    noise_mm2 = slope_variance * float(np.sum(answer**2 / np.tile(variance, 2)))
    return effects_mm, noise_mm2


def _variance_by_ring(patches: residual_patches.Patches, count: FloatArray) -> FloatArray:
    """Variance of a slope of one point (patches,), by the scatter in the patch's ring: wrinkles are
    at the rim alone.

    `count` (patches,) are the numbers of points, 0 for patches that are not used.
    """
    radius_mm = np.hypot(*patches.places_mm)
    ring = (radius_mm / max(float(radius_mm.max()), _TINY) * _RINGS).astype(int)
    ring = np.minimum(ring, _RINGS - 1)
    squares = count * np.sum(patches.slopes**2, axis=0) / 2
    of_ring = np.bincount(ring, squares, _RINGS) / np.maximum(
        np.bincount(ring, count > 0, _RINGS), 1.0
    )
    return np.asarray(of_ring[ring])


def _absorbed_terms(
    patches: residual_patches.Patches, radius_mm: float, inverse: FloatArray
) -> FloatArray:
    """Parameters (parameters, k) that least squares take for each term beyond the fit's."""
    x, y = patches.places_mm / radius_mm
    _, *slopes = surface_basis.evaluate_basis(x, y)
    _, *beyond_slopes = surface_basis.evaluate_beyond_basis(x, y)

    # (D^T W D)^-1 D^T W B, with B the slopes of the terms beyond, x and y together.
    products = sum(
        (own * patches.count) @ beyond.T for own, beyond in zip(slopes, beyond_slopes, strict=True)
    )
    return np.asarray(inverse @ products / radius_mm**2)


def _mean_of_rings(rings: RoundSlopes, absorbed: FloatArray, radius_mm: float) -> FloatArray:
    """Mean radial slopes (rings, k), in radii, that the fit leaves of the round terms beyond it."""
    # Points on circles within each ring.
    share = (np.arange(_RADII) + 0.5) / _RADII
    width_mm = (rings.outer_mm - rings.inner_mm)[:, None]
    radius = rings.inner_mm[:, None] + width_mm * share
    rho = np.repeat(radius.ravel() / radius_mm, _AZIMUTHS)
    azimuths = 2 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    theta = np.tile(azimuths, radius.size)
    cosine = np.cos(theta)
    sine = np.sin(theta)

    # Slopes of the terms beyond the fit, less those that the fit's parameters take of them.
    _, own_x, own_y = surface_basis.evaluate_basis(rho * cosine, rho * sine)
    _, beyond_x, beyond_y = surface_basis.evaluate_round_basis(rho * cosine, rho * sine)
    left_x = beyond_x - absorbed.T @ own_x
    left_y = beyond_y - absorbed.T @ own_y

    # Radial slopes, averaged over each circle, then over the ring with the circles' lengths.
    radial = left_x * cosine + left_y * sine
    of_radii = radial.reshape(-1, *radius.shape, _AZIMUTHS).mean(axis=-1)
    means = np.sum(of_radii * radius, axis=-1) / np.sum(radius, axis=-1)
    return np.asarray(means.T)


def _along_sag(covariance: FloatArray) -> FloatArray:
    """1 sigma (parameters,) of the sag, and of the parameters what is correlated with it."""
    with_sag = covariance @ sag_gradient()
    sigma_mm = math.sqrt(max(float(sag_gradient() @ with_sag), 0.0))
    return np.asarray(with_sag / max(sigma_mm, 1e-30))


def film_shape_sources(full: FullResult, slope_variance: FloatArray) -> tuple[budget.Source, ...]:
    """Rows of the budget for the film's round profile and for its waves.

    Parameters
    ----------
    full : FullResult
        The measured figure.
    slope_variance : (2,) array
        Of an x and of a y slope from the noise.

    Returns
    -------
    two Source
    """
    grid = full.fit_grid
    inverse = full.fit.normal.inverse
    radius_mm = full.surface.radius_mm
    variance = float(slope_variance.mean())

    # Slopes that the fit leaves, as patches and as means of rings.
    patches = residual_patches.Patches.from_grid(grid)
    seen = grid.count > 0
    x, y = np.meshgrid(grid.axis_mm, grid.axis_mm)
    places_mm = np.stack([x[seen], y[seen]])
    slopes = np.stack([grid.slope_x[seen], grid.slope_y[seen]])
    rings = RoundSlopes.from_points(places_mm, grid.count[seen], slopes, float(grid.axis_mm[-1]))

    # What the unexplained slopes allow of round terms and of waves beyond the fit's.
    of_round = round_effect(patches, rings, radius_mm, inverse, variance)
    of_waves = wave_effect(patches, radius_mm, inverse, variance)
    rows = (
        ("film_law", "film that is not Hencky's: round slopes that no term explains", of_round),
        ("film_waves", "film or ring that is not even: waves that no term explains", of_waves),
    )
    return tuple(
        budget.Source(name, description, math.nan, effects, common=False, noise_mm2=noise)
        for name, description, (effects, noise) in rows
    )
