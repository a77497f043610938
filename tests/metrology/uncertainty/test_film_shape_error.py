"""The row for waves of a film where wrinkles at the rim leave a selection of the slopes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.metrology.film import terms_beyond_fit
from membrane_ctrl.metrology.rays import surface_basis
from membrane_ctrl.metrology.rays.surface import parameter_to_coeffs
from membrane_ctrl.metrology.uncertainty.film_shape_error import (
    _most_similar_surfaces,
    wave_effect,
)
from membrane_ctrl.metrology.uncertainty.residual_patches import Patches

Array = NDArray[np.float64]
RADIUS_MM, REACH_MM, STEP_MM = 500.0, 475.0, 23.75
PIXELS = 60.0  # of a whole patch
WRINKLED_MM = 440.0
ASTIGMATISM = 5  # coefficient of Noll's term 6
# Number of a wave with two lobes among the terms beyond the fit, in mm.
WAVE = [abs(wave.azimuthal_order) for wave in terms_beyond_fit.WAVES].index(2)
AMPLITUDE_MM = 5e-5


def measured_patches(is_wrinkled: bool, noise: float) -> tuple[Patches, Array, float]:
    """Residual slopes of a film with a wave, the inverse of the fit, and the error of Z6 in µm."""
    axis_mm = np.arange(-REACH_MM + STEP_MM / 2, REACH_MM, STEP_MM)
    places_mm = np.stack([each.ravel() for each in np.meshgrid(axis_mm, axis_mm)])
    radius_mm = np.hypot(*places_mm)
    places_mm, radius_mm = places_mm[:, radius_mm < REACH_MM], radius_mm[radius_mm < REACH_MM]
    count = np.full(radius_mm.size, PIXELS)
    _, *basis = surface_basis.evaluate_basis(*places_mm / RADIUS_MM)
    _, *beyond = surface_basis.evaluate_beyond_basis(*places_mm / RADIUS_MM)
    place = np.arange(beyond[0].shape[0])[terms_beyond_fit.WAVE][WAVE]
    slopes = AMPLITUDE_MM / RADIUS_MM * np.stack([each[place] for each in beyond])
    slopes += noise * np.random.default_rng(1).standard_normal(slopes.shape)
    if is_wrinkled:
        # A tenth of the rim's slopes are left, which lean one way in six sectors.
        rim = radius_mm > WRINKLED_MM
        count[rim] *= 0.1
        x, y = places_mm / radius_mm
        slopes += 6e-5 * rim * np.cos(6 * np.arctan2(y, x)) * np.stack([x, y])
    normal = sum((of * count) @ of.T for of in basis) / RADIUS_MM**2
    right = sum((of * count) @ slope for of, slope in zip(basis, slopes, strict=True)) / RADIUS_MM
    inverse = np.asarray(np.linalg.inv(normal), float)
    taken_mm = inverse @ right
    left = slopes - np.stack([taken_mm @ of for of in basis]) / RADIUS_MM
    similar_mm = AMPLITUDE_MM * _most_similar_surfaces()[:, place]
    off_mm = parameter_to_coeffs()[ASTIGMATISM] @ (taken_mm - similar_mm)
    return Patches(places_mm, count, left), inverse, 1e3 * float(off_mm)


def row_um(patches: Patches, inverse: Array, noise: float) -> tuple[float, float]:
    """Effect on Z6 that the slopes show, and 1 sigma of what they do not."""
    effects_mm, _ = wave_effect(patches, RADIUS_MM, inverse, noise**2 * PIXELS)
    of_term_um = 1e3 * parameter_to_coeffs()[ASTIGMATISM] @ effects_mm
    return float(of_term_um[0]), float(np.linalg.norm(of_term_um[1:]))


def test_a_wave_that_the_slopes_show_is_in_its_row() -> None:
    patches, inverse, error_um = measured_patches(is_wrinkled=False, noise=1e-9)
    seen_um, unknown_um = row_um(patches, inverse, 1e-9)
    assert abs(error_um) > 0.002
    assert seen_um == pytest.approx(error_um, rel=0.1)
    assert unknown_um < 0.1 * abs(error_um)


def test_slopes_that_wrinkles_select_are_within_the_row() -> None:
    """Their residuals seemed to show no wave, and nothing was stated of what they cannot show."""
    noise = 1e-6
    patches, inverse, error_um = measured_patches(is_wrinkled=True, noise=noise)
    seen_um, unknown_um = row_um(patches, inverse, noise)
    assert abs(error_um) > 0.03
    assert abs(error_um - seen_um) < 2.0 * unknown_um
    assert unknown_um < 0.5 * abs(error_um)
