"""The image of a distant point against analytic optics."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.metrology.figure.star_image import image_star
from membrane_ctrl.model.arrays import FloatArray

CELLS, RADIUS_MM, FOCUS_MM, WAVELENGTH_UM = 64, 475.0, 1700.0, 100.0
AXIS_MM = (np.arange(CELLS) + 0.5) * 1000.0 / CELLS - 500.0
X, Y = np.meshgrid(AXIS_MM, AXIS_MM)
R = np.hypot(X, Y)


def paraboloid_mm() -> FloatArray:
    """A mirror that images a star on its axis perfectly."""
    return np.where(R < RADIUS_MM, R**2 / (4 * FOCUS_MM), np.nan)


def test_a_paraboloid_is_limited_by_diffraction() -> None:
    image = image_star(AXIS_MM, paraboloid_mm(), WAVELENGTH_UM)
    assert image.strehl == pytest.approx(1.0, abs=1e-6)
    assert image.focus_mm == pytest.approx(FOCUS_MM, abs=1e-6)
    # Half of the energy of Airy's disc is within 0.535 wavelength times focal ratio
    airy_um = 0.535 * WAVELENGTH_UM * FOCUS_MM / (2 * RADIUS_MM)
    assert image.radius_50_um == pytest.approx(airy_um, rel=0.06)
    assert image.resolved


def test_a_small_error_costs_what_marechal_states() -> None:
    """2 µm RMS of astigmatism on the surface are 4 µm of path at 100 µm, less the obliquity."""
    error_mm = 2e-3 * np.sqrt(6) * (X**2 - Y**2) / RADIUS_MM**2
    image = image_star(AXIS_MM, paraboloid_mm() + error_mm, WAVELENGTH_UM)
    assert image.path_rms_um == pytest.approx(4.0, rel=0.05)
    marechal = np.exp(-((2 * np.pi * image.path_rms_um / WAVELENGTH_UM) ** 2))
    assert image.strehl == pytest.approx(marechal, abs=2e-3)


def test_tilt_and_defocus_are_no_error() -> None:
    tilted = paraboloid_mm() + 1e-4 * X + 0.01 * (R / RADIUS_MM) ** 2
    image = image_star(AXIS_MM, tilted, WAVELENGTH_UM)
    assert image.strehl > 0.99
    assert image.focus_mm < FOCUS_MM


def test_path_differences_between_cells_that_exceed_a_wave_are_not_resolved() -> None:
    """Half a millimetre of ripple from cell to cell."""
    ripple = np.where(np.arange(CELLS) % 2, 0.25, -0.25)
    assert not image_star(AXIS_MM, paraboloid_mm() + ripple, WAVELENGTH_UM).resolved


def test_a_convex_mirror_has_no_image() -> None:
    with pytest.raises(ValueError, match="no focus"):
        image_star(AXIS_MM, -paraboloid_mm(), WAVELENGTH_UM)
