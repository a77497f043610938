"""The weights of vertex, focus and best fit, against surfaces that are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.metrology.figure.held_quantities import (
    make_held_scalars,
    measure_scalars,
    zernike_heights,
)
from membrane_ctrl.metrology.film import hencky_bowl
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from tests.worlds.changing_film import figure_change, true_focus_mm

SCALARS = make_held_scalars(500.0, 475.0, 37.1)
BOWL_UM = 37_100.0 * hencky_bowl.zernike_projection()
NO_NOISE = np.zeros((ZERNIKE_TERMS, ZERNIKE_TERMS))


@pytest.mark.parametrize("name", ["vertex", "focus", "best_fit"])
def test_every_scalar_counts_a_deeper_bowl_as_its_sag(name: str) -> None:
    assert SCALARS.weights_of(name) @ hencky_bowl.zernike_projection() == pytest.approx(1.0)


def test_the_focus_is_that_of_another_integration() -> None:
    """By a search on the distances from the centre, of Campbell's series of the bowl, whose seven
    terms leave 3e-4 of the radius.
    """
    found = measure_scalars(SCALARS, BOWL_UM, 37_100.0, NO_NOISE, BOWL_UM)
    assert found.focus_mm == pytest.approx(true_focus_mm(37_100.0, 0.0), rel=5e-4)
    changed = measure_scalars(SCALARS, BOWL_UM + figure_change(-1.5), 37_100.0, NO_NOISE, BOWL_UM)
    moved_mm = true_focus_mm(37_100.0, -1.5) - true_focus_mm(37_100.0, 0.0)
    assert changed.focus_mm - found.focus_mm == pytest.approx(moved_mm, rel=0.02)
    linear_mm = SCALARS.radius_per_term @ figure_change(-1.5) / 2
    assert linear_mm == pytest.approx(moved_mm, rel=0.02)


def test_no_other_depth_is_nearer_to_the_reference() -> None:
    rng = np.random.default_rng(1)
    change_um = rng.normal(size=ZERNIKE_TERMS)
    found = measure_scalars(SCALARS, BOWL_UM + change_um, 37_100.0, NO_NOISE, BOWL_UM)
    at_best_um = change_um - (SCALARS.best_fit @ change_um) * hencky_bowl.zernike_projection()
    least = measure_scalars(SCALARS, BOWL_UM + at_best_um, 37_100.0, NO_NOISE, BOWL_UM)
    assert least.rms_um == pytest.approx(found.least_rms_um, rel=1e-3)
    assert found.rms_um > least.rms_um


def test_piston_and_tilt_are_no_change_of_the_figure() -> None:
    change_um = np.zeros(ZERNIKE_TERMS)
    change_um[:3] = 3.0, 2.0, -1.0
    found = measure_scalars(SCALARS, BOWL_UM + change_um, 37_100.0, NO_NOISE, BOWL_UM)
    assert found.rms_um == pytest.approx(0.0, abs=1e-6)


def test_the_error_bars_hold_what_noise_does() -> None:
    """Scatter of 400 noisy figures; the mean of the RMS is free of what noise adds."""
    rng = np.random.default_rng(2)
    factor = 0.02 * rng.normal(size=(ZERNIKE_TERMS, ZERNIKE_TERMS))
    covariance = factor @ factor.T
    noise_um = (factor @ rng.normal(size=(ZERNIKE_TERMS, 400))).T
    change_um = figure_change(1.5)
    found = [
        measure_scalars(SCALARS, BOWL_UM + change_um + each, 37_100.0, covariance, BOWL_UM)
        for each in noise_um
    ]
    for name, sigma in (
        ("vertex_um", "vertex_sigma_um"),
        ("focus_mm", "focus_sigma_mm"),
        ("rms_um", "rms_sigma_um"),
    ):
        scatter = np.std([getattr(each, name) for each in found])
        stated = np.mean([getattr(each, sigma) for each in found])
        assert scatter == pytest.approx(stated, rel=0.12), name
    quiet = measure_scalars(SCALARS, BOWL_UM + change_um, 37_100.0, NO_NOISE, BOWL_UM)
    mean_square = np.mean([each.rms_um**2 for each in found])
    assert mean_square == pytest.approx(quiet.rms_um**2, rel=0.02)


def test_the_terms_are_those_of_the_fit() -> None:
    """Z4 and Z11 in closed form."""
    x, y = np.array([0.3, -0.2]), np.array([0.1, 0.8])
    rho2 = x**2 + y**2
    terms = zernike_heights(x, y)
    assert terms[:, 3] == pytest.approx(np.sqrt(3) * (2 * rho2 - 1))
    assert terms[:, 10] == pytest.approx(np.sqrt(5) * (6 * rho2**2 - 6 * rho2 + 1))
