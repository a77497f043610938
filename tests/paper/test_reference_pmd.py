"""The paper's equations, against rays that are reflected here."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.paper.reference_iteration import (
    POWERS,
    PolynomialSurface,
    SeenPoints,
    make_cone,
    make_parabola,
    make_v_fold,
    predict_seen,
    reconstruct,
)
from membrane_ctrl.paper.reference_pmd import (
    PaperGeometry,
    Reflection,
    YReading,
    compute_slope,
    compute_slopes,
    predict_screen,
)

GEOMETRIES = {
    "the paper's": PaperGeometry(2672.0, 2871.0, math.radians(80.9)),
    "another": PaperGeometry(1900.0, 1500.0, math.radians(72.0)),
}
Shape = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray, FloatArray]]


def saddle(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Height and slopes of a bowl with astigmatism, coma and a tilt."""
    height = 1.5e-4 * x**2 + 1.3e-4 * y**2 + 1e-5 * x * y + 4e-8 * x**3 - 2e-3 * x + 1e-3 * y
    slope_x = 3e-4 * x + 1e-5 * y + 12e-8 * x**2 - 2e-3
    slope_y = 2.6e-4 * y + 1e-5 * x + 1e-3
    return height, slope_x, slope_y


def round_bowl(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A paraboloid about the vertex."""
    return 1.4e-4 * (x**2 + y**2), 2.8e-4 * x, 2.8e-4 * y


def flat(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A level plane."""
    return 0 * x, 0 * x, 0 * y


def points_on_disc(count: int) -> tuple[FloatArray, FloatArray]:
    """Even points over 475 mm."""
    random = np.random.default_rng(3)
    radius = 475.0 * np.sqrt(random.random(count))
    angle = 2 * np.pi * random.random(count)
    return radius * np.cos(angle), radius * np.sin(angle)


def reflect(
    bench: PaperGeometry, shape: Shape, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, Reflection]:
    """Points (3, n), slopes (2, n), screen points (2, n) and rays, by vectors."""
    height, slope_x, slope_y = shape(x, y)
    points = np.stack([x, y, height])
    cosine, sine = math.cos(bench.alpha_rad), math.sin(bench.alpha_rad)
    pinhole = bench.a_mm * np.array([cosine, 0.0, sine])
    centre = bench.b_mm * np.array([-cosine, 0.0, sine])
    normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    incident = points.T - pinhole
    incident /= np.linalg.norm(incident, axis=1, keepdims=True)
    reflected = incident - 2 * np.sum(incident * normal, axis=1, keepdims=True) * normal
    # the screen is perpendicular to O O'
    face = centre / np.linalg.norm(centre)
    reach = (np.linalg.norm(centre) - points.T @ face) / (reflected @ face)
    on_screen = points.T + reach[:, None] * reflected - centre
    along_x = np.array([-sine, 0.0, -cosine])
    screen = np.stack([on_screen @ along_x, on_screen[:, 1]])
    return points, np.stack([slope_x, slope_y]), screen, Reflection(normal, incident, reflected)


@pytest.mark.parametrize("name", GEOMETRIES)
@pytest.mark.parametrize("shape", [saddle, flat])
def test_slopes_are_exact_for_a_known_surface(name: str, shape: Shape) -> None:
    points, slopes, screen, rays = reflect(GEOMETRIES[name], shape, *points_on_disc(400))
    found = compute_slopes(GEOMETRIES[name], points, screen, rays)
    np.testing.assert_allclose(found, slopes, rtol=0, atol=1e-13)


def test_only_one_reading_of_the_y_equations_is_exact() -> None:
    bench = GEOMETRIES["the paper's"]
    points, slopes, screen, rays = reflect(bench, saddle, *points_on_disc(400))
    off = {
        reading: np.max(np.abs(compute_slopes(bench, points, screen, rays, reading)[1] - slopes[1]))
        for reading in YReading
    }
    assert off[YReading.HEIGHT_OF_POINT] < 1e-12
    assert 5e-5 < off[YReading.HEIGHT_OF_CENTRE] < off[YReading.CHIEF_RAY]


def test_the_projection_needs_its_correction_beside_the_plane_of_the_camera_alone() -> None:
    bench = GEOMETRIES["the paper's"]
    x = np.linspace(-400.0, 400.0, 9)
    for y_mm, exact in ((0.0, True), (300.0, False)):
        points, slopes, screen, _ = reflect(bench, round_bowl, x, np.full_like(x, y_mm))
        error = np.abs(compute_slopes(bench, points, screen, None)[0] - slopes[0])
        assert bool(np.max(error) < 1e-13) is exact


def test_the_screen_is_predicted_from_the_slope() -> None:
    bench = GEOMETRIES["another"]
    x, height, slope = np.array([-300.0, 10.0, 250.0]), np.array([20.0, 0.0, 12.0]), 0.05
    screen = predict_screen(bench, x, height, np.full(3, slope))
    np.testing.assert_allclose(compute_slope(bench, x, height, screen), slope, atol=1e-14)


@pytest.mark.parametrize("start", [make_parabola(10.0, 500.0), make_parabola(100.0, 500.0)])
def test_the_iteration_finds_the_surface(start: object) -> None:
    bench = GEOMETRIES["the paper's"]
    x, y = points_on_disc(1500)
    points, _, screen, rays = reflect(bench, saddle, x, y)
    seen = SeenPoints(rays.incident.T, screen)
    found = reconstruct(bench, seen, start, 500.0, 475.0, 10)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.surface.height_mm(x, y), points[2], atol=1e-9)
    assert found.changes_mm[-1] < 1e-11


def test_every_start_ends_at_the_same_surface() -> None:
    bench = GEOMETRIES["another"]
    _, _, screen, rays = reflect(bench, saddle, *points_on_disc(1500))
    seen = SeenPoints(rays.incident.T, screen)
    starts = [make_parabola(40.0, 500.0), make_cone(40.0, 500.0), make_v_fold(40.0, 500.0)]
    found = [reconstruct(bench, seen, start, 500.0, 475.0, 12).surface for start in starts]
    for each in found[1:]:
        np.testing.assert_allclose(each.coeffs_mm, found[0].coeffs_mm, rtol=0, atol=1e-9)


def test_the_monomials_are_as_many_as_36_terms_without_piston() -> None:
    assert len(POWERS) == 35
    assert (0, 0) not in POWERS


def test_no_iteration_is_no_solution() -> None:
    seen = SeenPoints(np.zeros((3, 1)), np.zeros((2, 1)))
    with pytest.raises(ValueError, match="at least 1"):
        reconstruct(GEOMETRIES["another"], seen, make_parabola(1.0, 500.0), 500.0, 475.0, 0)


def test_what_a_camera_sees_is_predicted() -> None:
    bench = GEOMETRIES["another"]
    _, _, screen, rays = reflect(bench, round_bowl, *points_on_disc(100))
    coeffs = np.zeros(len(POWERS))
    coeffs[[POWERS.index((2, 0)), POWERS.index((0, 2))]] = 1.4e-4 * 500.0**2
    found = predict_seen(bench, rays.incident.T, PolynomialSurface(coeffs, 500.0))
    np.testing.assert_allclose(found.screen_mm, screen, atol=1e-9)
