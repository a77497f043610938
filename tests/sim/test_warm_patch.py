"""The twin's warm patch against a film of finite strains, and what figures show of a climate."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.optics import CameraConfig, OpticsConfig
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.phase.pattern_sequence import full_sequence
from membrane_ctrl.sim.climate import (
    FILM_PPM_PER_K,
    LAMP_K,
    POISSON_RATIO,
    Room,
)
from membrane_ctrl.sim.figure_changes import climate_change, lamp_change, list_figure_changes
from membrane_ctrl.sim.film import NOMINAL_SAG_MM, RADIUS_MM
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.truth import Truth
from membrane_ctrl.sim.warm_patch import Patch, compute_patch_polynomial
from tests.worlds.climate_terms import compute_figure_change_per_ppm
from tests.worlds.second_optics import Material
from tests.worlds.second_optics.film import FilmSolver, WarmPatch

RADII, ANGLES = np.sqrt((np.arange(30) + 0.5) / 30), 2 * np.pi * np.arange(36) / 36
X = np.outer(RADII, np.cos(ANGLES)).ravel()
Y = np.outer(RADII, np.sin(ANGLES)).ravel()
TRUTH = Truth(0.0, 0.0, 37.1, 63.4, 600.0, 101325.0, 20.0, 20.0, 0.0, 0.0, 1.0, 1.0, 0.0)


def heights_um(poly_um: np.ndarray) -> np.ndarray:
    return np.asarray(np.polynomial.polynomial.polyval2d(X, Y, poly_um))


@pytest.mark.parametrize("place_mm", [(0.0, 0.0), (150.0, 90.0)])
def test_a_patch_is_that_of_a_film_of_finite_strains(place_mm: tuple[float, float]) -> None:
    """1 K in the middle of 90 mm; at the vertex, which is 0, the polynomials are the limit."""
    depth = NOMINAL_SAG_MM / RADIUS_MM
    warm = WarmPatch(17e-6, place_mm[0] / RADIUS_MM, place_mm[1] / RADIUS_MM)
    shapes = []
    for patch in (None, warm):
        shape, _ = FilmSolver(Material(1.0, POISSON_RATIO), degree=10, warm=patch).solve(depth)
        w = shape.w.values(np.append(X, 0.0), np.append(Y, 0.0))[0]
        u = shape.u.values(X, Y)
        v = shape.v.values(X, Y)
        # Height over the place where the material point is now, to first order
        slopes = shape.w.values(X, Y)
        shapes.append(w[:-1] - w[-1] - slopes[1] * u[0] - slopes[2] * v[0])
    true_um = 1e3 * RADIUS_MM * (shapes[1] - shapes[0])
    found_um = 17.0 * heights_um(compute_patch_polynomial(Patch(*place_mm, 90.0)))
    rms_um = float(np.sqrt(np.mean(true_um**2)))
    assert 1.2 < rms_um < 2.6
    assert np.sqrt(np.mean((found_um - true_um) ** 2)) < 0.1 * rms_um


def test_a_film_that_is_warm_all_over_changes_as_the_round_solution_does() -> None:
    everywhere = heights_um(compute_patch_polynomial(Patch(0.0, 0.0, 1e6)))
    round_um = heights_um(np.array(climate_change().poly_um))
    assert everywhere == pytest.approx(round_um, abs=0.02 * np.abs(round_um).max())


def test_a_lamp_changes_the_figure_beside_the_mean_strain() -> None:
    room = Room(type("Twin", (), {"climate": "lamp", "seed": 1})())
    block = room.make_block(np.array([0.0, 300.0, 3500.0]))
    assert block.patch_k == pytest.approx([0.0, LAMP_K, 0.0], abs=0.01)
    truth = replace(TRUTH, **block.truth_at(1))
    (uniform, excess_ppm), (lamp, kelvin) = list_figure_changes(truth)
    assert (uniform, lamp) == (climate_change(), lamp_change())
    whole = excess_ppm * heights_um(np.array(uniform.poly_um))
    whole = whole + kelvin * heights_um(np.array(lamp.poly_um))
    patch = Patch(150.0, 90.0, 90.0)
    alone = kelvin * FILM_PPM_PER_K * heights_um(compute_patch_polynomial(patch))
    assert whole == pytest.approx(alone, abs=0.05 * np.abs(alone).max())
    assert math.isclose(float(np.array(lamp.poly_um)[0, 0]), 0.0, abs_tol=1e-12)


def test_the_simulated_camera_sees_the_climate() -> None:
    """50e-6 of excess strain are 4.1 µm of spherical aberration in a full cycle."""
    optics = OpticsConfig(camera=CameraConfig(width_px=306, height_px=256, pixel_um=27.6, bits=12))
    renderer = OpticsRenderer(optics, typical_film(37.1, 500.0, 1))
    found = []
    for excess_ppm in (0.0, 50.0):
        changes = list_figure_changes(replace(TRUTH, excess_strain_ppm=excess_ppm))
        frames = [
            renderer.render_picture(pattern, 0.0, changes=changes)
            for pattern in full_sequence(optics.pattern)
        ]
        cycle = LiveReconstructor(optics, 1)
        found.append(cycle.measure_full(frames, np.arange(18.0), np.zeros(18)))
    change_um = found[1].coeffs_um - found[0].coeffs_um
    expected_um = 50.0 * compute_figure_change_per_ppm()
    assert change_um[10] == pytest.approx(expected_um[2], abs=0.05)
    assert change_um[3] == pytest.approx(expected_um[1], abs=0.05)
    assert found[1].sag_um == pytest.approx(found[0].sag_um, abs=0.1)


def test_a_steady_room_changes_nothing() -> None:
    assert list_figure_changes(TRUTH) == ()
