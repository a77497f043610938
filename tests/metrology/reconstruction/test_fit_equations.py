"""Moments of the slope fit and the effect of the screen on slopes, against sums over the points."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.metrology.film import film_form
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.metrology.rays.surface_basis import evaluate_basis
from membrane_ctrl.metrology.reconstruction.normal_matrix import (
    NormalMatrix,
    residual_rms,
    right_side,
)
from membrane_ctrl.metrology.reconstruction.slope_noise import slope_per_screen
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE
from tests.support.metrology_truth import OPTICS, RADIUS_MM

FloatArray = NDArray[np.float64]
POINTS = 400


def residual_moments(
    x: FloatArray, y: FloatArray, slopes: FloatArray, weights: FloatArray
) -> FloatArray:
    """As `kernels.residual_sums` orders them, by plain sums."""
    monomials = np.stack(
        [x**p * y**q for p in range(ZERNIKE_DEGREE) for q in range(ZERNIKE_DEGREE - p)]
    )
    _, excess_x, excess_y = (part[-1] for part in evaluate_basis(x, y))
    weighted = weights * slopes
    of_excess = [weighted[0] @ excess_x / 2, weighted[1] @ excess_y / 2]
    squares = np.sum(weighted * slopes, axis=1)
    return np.concatenate(
        [monomials @ weighted[0], monomials @ weighted[1], of_excess, squares, [weights.sum()]]
    )


def test_right_side_and_residual_are_those_of_sums_over_the_points() -> None:
    rng = np.random.default_rng(5)
    radius, angle = np.sqrt(rng.random(POINTS)), 2 * np.pi * rng.random(POINTS)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    slopes, weights = 1e-3 * rng.standard_normal((2, POINTS)), rng.uniform(0.2, 1.0, POINTS)
    designs = [part / RADIUS_MM for part in evaluate_basis(x, y)[1:]]
    of_axes = [(design * weights) @ design.T for design in designs]
    inverse = np.asarray(np.linalg.inv(of_axes[0] + of_axes[1]), float)
    normal = NormalMatrix(of_axes[0], of_axes[1], inverse)

    sums = residual_moments(x, y, slopes, weights)
    right = right_side(sums, RADIUS_MM)
    wanted = [design @ (weights * part) for design, part in zip(designs, slopes, strict=True)]
    assert right == pytest.approx(np.stack(wanted), rel=1e-9, abs=1e-12)

    delta_mm = 0.05 * rng.standard_normal(PARAMETERS)
    found = residual_rms(sums, right, normal, delta_mm)
    for axis in (0, 1):
        left = slopes[axis] - designs[axis].T @ delta_mm
        assert found[axis] == pytest.approx(np.sqrt(np.average(left**2, weights=weights)), rel=1e-6)


def test_slopes_by_the_screen_are_those_of_a_screen_point_that_moves() -> None:
    """The bisector of camera ray and the ray to a screen point that is 1 µm farther."""
    geometry, sag_mm, step_mm = Geometry.from_config(OPTICS), 37.0, 1e-3
    axis_mm = np.linspace(-0.9, 0.9, 15) * RADIUS_MM
    x, y = (part.ravel() for part in np.meshgrid(axis_mm, axis_mm))
    inside = np.hypot(x, y) <= 0.95 * RADIUS_MM
    x, y = x[inside], y[inside]
    point = np.stack([x, y, sag_mm * (x**2 + y**2) / RADIUS_MM**2])
    ray = point - geometry.pinhole_mm[:, None]
    ray /= np.linalg.norm(ray, axis=0)
    bowl = 2 * sag_mm / RADIUS_MM**2 * np.stack([x, y])
    normal = np.vstack([-bowl, np.ones_like(x)]) / np.sqrt(1 + np.sum(bowl**2, axis=0))
    leaves = ray - 2 * np.sum(ray * normal, axis=0) * normal
    face = np.cross(geometry.screen_s_x, geometry.screen_s_y)
    reach = face @ (geometry.screen_origin_mm[:, None] - point) / (face @ leaves)
    seen = point + reach * leaves

    def slopes(screen_mm: FloatArray) -> FloatArray:
        to_screen = screen_mm - point
        bisector = to_screen / np.linalg.norm(to_screen, axis=0) - ray
        return np.asarray(-bisector[:2] / bisector[2])

    assert slopes(seen) == pytest.approx(bowl, abs=1e-12)
    found = slope_per_screen(geometry, RADIUS_MM, sag_mm)
    for k, along in enumerate((geometry.screen_s_x, geometry.screen_s_y)):
        step = step_mm * along[:, None]
        change = (slopes(seen + step) - slopes(seen - step)) / (2 * step_mm)
        assert found[:, k] == pytest.approx(np.mean(change**2, axis=1), rel=1e-5)


def test_a_films_form_has_a_constant_a_linear_and_a_quadratic_part() -> None:
    """In units of 4 mm of sag."""
    assert film_form.depth_powers(0.0) == pytest.approx([1.0, 0.0, 0.0])
    assert film_form.depth_powers(8.0) == pytest.approx([1.0, 2.0, 4.0])
    assert film_form.depth_powers(-4.0) == pytest.approx([1.0, -1.0, 1.0])
