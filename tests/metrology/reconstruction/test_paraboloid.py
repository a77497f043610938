"""Paraboloid from slopes, and a facet traced and solved."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.screen_face import Face
from tests.support.facet import Paraboloid, Sight, fit_slopes, measure_on, solve_facet, turned

TRUE = Paraboloid(1e-3, -2e-3, 1 / 240e3, -3e-7, 1 / 218e3)


def grid(count=40, half_mm=600.0):
    return (axis.ravel() for axis in np.meshgrid(*[np.linspace(-half_mm, half_mm, count)] * 2))


@pytest.mark.parametrize("loss", ["squares", "huber", "tukey"])
def test_exact_slopes_give_the_paraboloid(loss):
    x, y = grid()
    surface = fit_slopes(x, y, TRUE.slopes(x, y), loss).surface
    assert surface.focal_x_mm == pytest.approx(120e3, rel=1e-9)
    assert surface.focal_y_mm == pytest.approx(109e3, rel=1e-9)
    assert surface.curvature_xy_per_mm == pytest.approx(-3e-7, rel=1e-9)
    assert surface.tilt_y == pytest.approx(-2e-3, rel=1e-9)


def test_a_turned_down_edge_hardly_changes_robust_fits():
    x, y = grid()
    rng = np.random.default_rng(1)
    slopes = TRUE.slopes(x, y) + rng.normal(0, 2e-4, (2, x.size))
    slopes[0, x > 560] += 5e-3
    error = {
        loss: abs(fit_slopes(x, y, slopes, loss).surface.focal_x_mm / 120e3 - 1)
        for loss in ("squares", "huber", "tukey")
    }
    assert error["squares"] > 0.05
    assert error["huber"] < error["squares"] / 3
    assert error["tukey"] < 5e-3
    fit = fit_slopes(x, y, slopes, "tukey")
    assert np.all(fit.weights[0, x > 560] == 0)
    assert (
        fit.weights[1, x > 560].mean() > 0.8
    )  # the other component of the same pixel is good and is used


@pytest.mark.parametrize("loss", ["squares", "huber", "tukey"])
def test_gaussian_noise_costs_a_robust_fit_little(loss):
    x, y = grid(20)
    rng = np.random.default_rng(2)
    noisy = [TRUE.slopes(x, y) + rng.normal(0, 1e-4, (2, x.size)) for _ in range(60)]
    scatter = np.std(
        [fit_slopes(x, y, slopes, loss).surface.curvature_xx_per_mm for slopes in noisy]
    )
    assert scatter == pytest.approx(1e-4 / np.sqrt(np.sum(x**2)), rel=0.3)


def test_points_on_a_line_and_nan_are_refused():
    x = np.linspace(-1, 1, 20)
    with pytest.raises(ValueError, match="do not determine"):
        fit_slopes(x, np.zeros_like(x), np.zeros((2, 20)))
    with pytest.raises(ValueError, match="not finite"):
        fit_slopes(x, x**2, np.full((2, 20), np.nan))


def test_rays_meet_the_surface_first_side_up():
    origin = np.array([300.0, -200.0, 9600.0])
    x, y = grid(9)
    target = np.stack([x, y, TRUE.height_mm(x, y)])
    rays = target - origin[:, None]
    np.testing.assert_allclose(
        TRUE.intersect(origin, rays / np.linalg.norm(rays, axis=0)), target, atol=1e-9
    )


def test_rays_meet_a_plane_and_miss_a_bowl():
    flat = Paraboloid(0.0, 0.0, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(
        flat.intersect(np.array([0.0, 0.0, 10.0]), np.array([[0.6], [0.0], [-0.8]])),
        [[7.5], [0.0], [0.0]],
    )
    dome = replace(flat, curvature_xx_per_mm=-1.0)
    assert np.isnan(
        dome.intersect(np.array([0.0, 0.0, 1.0]), np.array([[1.0], [0.0], [0.0]]))
    ).all()


def rig():
    """Camera and screen ten metres before the facet, beside each other."""
    return Geometry(
        pinhole_mm=np.array([-2000.0, 100.0, 9500.0]),
        rotation=np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]),
        focal_px=700.0,
        principal_px=(100.0, 75.0),
        distortion=(),
        screen_origin_mm=np.array([2000.0, -100.0, 10_000.0]),
        screen_s_x=np.array([1.0, 0.0, 0.0]),
        screen_s_y=np.array([0.0, 1.0, 0.0]),
        face=Face.from_config(None),
    )


def seen(surface, geometry, columns, rows):
    """Screen points that mirror-reflected rays meet: traced forward, v - 2 (v n) n."""
    rays = geometry.rays(columns, rows)
    points = surface.intersect(geometry.pinhole_mm, rays)
    normal = np.concatenate([-surface.slopes(points[0], points[1]), np.ones((1, points.shape[1]))])
    normal /= np.linalg.norm(normal, axis=0)
    out = rays - 2 * np.sum(rays * normal, axis=0) * normal
    face = np.cross(geometry.screen_s_x, geometry.screen_s_y)
    reach = face @ (geometry.screen_origin_mm[:, None] - points) / (face @ out)
    place = points + reach * out - geometry.screen_origin_mm[:, None]
    return np.stack([geometry.screen_s_x @ place, geometry.screen_s_y @ place])


def test_a_traced_facet_is_found_again():
    geometry = rig()
    columns, rows = (
        axis.ravel() for axis in np.meshgrid(np.arange(205.0, 290.0, 6), np.arange(40.0, 125.0, 6))
    )
    level = replace(TRUE, tilt_x=0.0, tilt_y=0.0)
    sight = Sight(columns, rows, seen(level, geometry, columns, rows))
    points, slopes = measure_on(level, geometry, sight)
    np.testing.assert_allclose(slopes, level.slopes(points[0], points[1]), atol=1e-14)
    rough = Rotation.from_rotvec(
        [4e-3, -7e-3, 0.0]
    ).as_matrix()  # as badly as a pose from corners is known
    found = solve_facet(turned(geometry, rough), sight)
    assert found.fit.surface.focal_x_mm == pytest.approx(120e3, rel=1e-6)
    assert found.fit.surface.focal_y_mm == pytest.approx(109e3, rel=1e-6)
    assert found.geometry.pinhole_mm[2] == pytest.approx(geometry.pinhole_mm[2], abs=1e-3)
    np.testing.assert_allclose(found.fit.residual, 0, atol=1e-9)


def test_a_pixel_that_sees_no_screen_is_refused():
    with pytest.raises(ValueError, match="not finite"):
        solve_facet(
            rig(), Sight(np.array([240.0, 250.0]), np.array([75.0, 80.0]), np.full((2, 2), np.nan))
        )


def test_thinning_keeps_pixels_together():
    sight = Sight(
        np.arange(10.0), np.arange(10.0) + 100, np.stack([np.arange(10.0), -np.arange(10.0)])
    ).every(4)
    assert sight.columns_px.tolist() == [0, 4, 8]
    assert sight.rows_px.tolist() == [100, 104, 108]
    assert sight.screen_mm.tolist() == [[0, 4, 8], [0, -4, -8]]
