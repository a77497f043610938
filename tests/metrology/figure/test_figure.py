"""The metrologist's figure against closed forms, prysm, and a ray trace and a sphere fit by other
means.
"""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest
from prysm import interferogram
from prysm.polynomials import ansi_j_to_nm, fringe_to_nm, noll_to_nm, zernike_nm
from scipy.optimize import least_squares, minimize_scalar

from membrane_ctrl.metrology.figure import (
    best_sphere,
    error_bars,
    power_spectrum,
    quantities,
    surface_map,
)
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.model.zernike_terms import NOLL_INDICES, ZERNIKE_TERMS
from tests.support.metrology_truth import TrueFilm

APERTURE = 475.0
AXIS = np.linspace(-APERTURE, APERTURE, 125)
X, Y = np.meshgrid(AXIS, AXIS)
R, THETA = np.hypot(X, Y), np.arctan2(Y, X)
INSIDE = R <= APERTURE
ABERRATED = {5: 0.004, 6: -0.3, 7: 0.1, 10: -0.05, 11: 0.02, 22: 0.004, 33: 0.003}


def seen(height_mm: np.ndarray, hole: bool = False) -> surface_map.SurfaceMap:
    """A measured map, optionally with a hole."""
    measured = INSIDE & ~(hole & (np.hypot(X - 90, Y + 40) < 60))
    slope_y, slope_x = np.gradient(height_mm, float(AXIS[1] - AXIS[0]), edge_order=2)
    return surface_map.SurfaceMap(AXIS, np.where(measured, height_mm, np.nan), slope_x, slope_y)


def height_of(film: TrueFilm) -> np.ndarray:
    """Its height on the grid."""
    return film.height(X.ravel(), Y.ravel()).reshape(X.shape)


def of(shown: surface_map.SurfaceMap) -> quantities.Figure:
    """Its figure."""
    return quantities.FigureOf(shown, APERTURE)(shown)


def bars_of(
    some: surface_map.SurfaceMap, covariance: np.ndarray, cell_slope: float = 0.0
) -> error_bars.FigureBars:
    """Its error bars."""
    evaluate = quantities.FigureOf(some, APERTURE)
    trials = error_bars.FigureTrials(evaluate, some, evaluate(some), 500.0)
    return trials.figure_bars(covariance, cell_slope)


def ball(radius_mm: float, tilt_x: float = 0.0, tilt_y: float = 0.0) -> np.ndarray:
    """Height of a sphere whose normal at the vertex is tilted."""
    normal = np.array([-tilt_x, -tilt_y, 1.0]) / np.sqrt(1 + tilt_x**2 + tilt_y**2)
    centre = radius_mm * normal
    left = radius_mm**2 - (X - centre[0]) ** 2 - (Y - centre[1]) ** 2
    return centre[2] - np.sign(radius_mm) * np.sqrt(np.maximum(left, 0))


def test_a_tilted_sphere_has_its_radius_tilt_and_no_irregularity() -> None:
    for radius in (3400.0, -2500.0, 1200.0):
        found = of(seen(ball(radius, 2e-3, -1e-3) + 0.25, hole=True)).numbers
        assert found.radius_of_curvature_mm == pytest.approx(radius, rel=1e-9)
        assert found.focal_length_mm == pytest.approx(radius / 2, rel=1e-9)
        assert found.tilt_x_urad == pytest.approx(2000, abs=1e-5)
        assert found.tilt_y_urad == pytest.approx(-1000, abs=1e-5)
        assert found.irregularity_pv_um < 1e-6
        depth = abs(radius) - np.sqrt(radius**2 - APERTURE**2)
        assert found.sphere_sag_mm == pytest.approx(np.sign(radius) * depth, rel=1e-9)


def test_a_flat_with_a_bump_is_no_exception() -> None:
    bump = 1e-3 * np.exp(-((X - 100) ** 2 + Y**2) / (2 * 20.0**2))
    found = of(seen(bump + 1e-5 * X))
    assert abs(found.sphere.curvature_per_mm) < 1e-8
    assert found.numbers.irregularity_pv_um == pytest.approx(1.0, rel=0.03)


def test_from_a_sphere_nearby_the_same_sphere_is_found() -> None:
    cloud = seen(height_of(TrueFilm(37.0, ABERRATED)), hole=True).points()
    found = best_sphere.best_sphere(cloud)
    for near in (
        best_sphere.Sphere(
            found.vertex_mm + 0.3, found.tilt_x - 1e-3, found.tilt_y + 5e-4, 1 / 3300.0
        ),
        best_sphere.Sphere(found.vertex_mm, found.tilt_x, found.tilt_y, found.curvature_per_mm),
    ):
        again = best_sphere.best_sphere(cloud, near)
        assert again.vertex_mm == pytest.approx(found.vertex_mm, abs=1e-6)
        assert again.tilt_x == pytest.approx(found.tilt_x, abs=1e-8)
        assert again.tilt_y == pytest.approx(found.tilt_y, abs=1e-8)
        assert again.curvature_per_mm == pytest.approx(found.curvature_per_mm, rel=1e-7)


def test_the_sphere_has_the_least_squares_of_the_distances() -> None:
    cloud = seen(height_of(TrueFilm(37.0, ABERRATED)), hole=True).points()

    def distances(p: np.ndarray) -> np.ndarray:
        return np.linalg.norm(cloud - p[:3, None], axis=0) - p[3]

    best = least_squares(
        distances, [0, 0, 3400, 3400], x_scale=[1, 1, 1e3, 1e3], xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    found = best_sphere.best_sphere(cloud)
    assert 1 / found.curvature_per_mm == pytest.approx(best.x[3], rel=1e-7)
    np.testing.assert_allclose(found.deviation(cloud)[0], -distances(best.x), atol=1e-6)


def test_pv_rms_and_pvr_agree_with_prysm() -> None:
    found = of(
        seen(ball(3400.0) + height_of(TrueFilm(0.0, {6: 0.01, 8: -0.004, 17: 0.002, 30: 0.001})))
    )
    other = interferogram.Interferogram(found.deviation_um, dx=float(AXIS[1] - AXIS[0]))
    assert found.numbers.irregularity_pv_um == pytest.approx(other.pv, rel=1e-12)
    assert found.numbers.irregularity_rms_um == pytest.approx(other.rms, rel=1e-9)
    # prysm fits one term more (its 37th, n = m = 6)
    assert found.numbers.pvr_um == pytest.approx(other.pvr(APERTURE + 1e-3), rel=1e-3)


def test_terms_of_each_index_are_those_of_prysm() -> None:
    assert [zernike.fringe_set_orders(j) for j in range(1, 37)] == [
        tuple(fringe_to_nm(j)) for j in range(1, 37)
    ]
    assert zernike.fringe_set_orders(37) == (12, 0)
    noll = [noll_to_nm(j) for j in NOLL_INDICES]
    osa = [noll[k] for k in zernike.osa_from_noll(np.arange(ZERNIKE_TERMS))]
    assert osa == [tuple(ansi_j_to_nm(j)) for j in range(ZERNIKE_TERMS)]
    with pytest.raises(ValueError, match="1 to 37"):
        zernike.fringe_set_orders(38)


def test_fringe_terms_are_refitted_over_a_map_with_a_hole() -> None:
    wanted = np.random.default_rng(3).normal(0, 100, 37)
    rho = R / APERTURE
    terms = [
        zernike_nm(*zernike.fringe_set_orders(j), rho, THETA, norm=False) for j in range(1, 38)
    ]
    height = 1e-3 * np.tensordot(wanted, terms, axes=1)
    np.testing.assert_allclose(of(seen(height, hole=True)).fringe_um, wanted, atol=1e-5)


def test_the_rotationally_invariant_part_is_separated_from_the_rest() -> None:
    rho = R / APERTURE
    round_um = 3 * (6 * rho**4 - 6 * rho**2 + 1) + 0.4 * np.cos(2 * np.pi * R / 60)
    rest_um = 5 * rho**2 * np.cos(2 * THETA) + 2 * np.sin(X / 9)
    found = of(seen(ball(3400.0) + 1e-3 * (round_um + rest_um)))
    assert found.numbers.rotational_pv_um == pytest.approx(np.ptp(round_um[INSIDE]), rel=0.04)
    assert found.numbers.asymmetry_rms_um == pytest.approx(
        np.sqrt(np.mean(rest_um[INSIDE] ** 2)), rel=0.02
    )


def test_slopes_of_a_ripple() -> None:
    found = of(seen(ball(3400.0) + 0.002 * np.sin(2 * np.pi * X / 200)))
    assert found.numbers.slope_rms_urad == pytest.approx(
        1e6 * 0.002 * 2 * np.pi / 200 / np.sqrt(2), rel=0.03
    )


def test_the_spot_of_a_paraboloid_is_a_point_in_its_focus() -> None:
    found = of(seen((X**2 + Y**2) / (4 * 1700.0))).numbers
    assert found.best_focus_mm == pytest.approx(1700, abs=1e-3)
    assert found.spot_95_mm < 1e-6
    assert found.strehl == pytest.approx(1.0, abs=1e-9)
    assert found.star_path_rms_um < 1e-6


def test_the_spot_agrees_with_a_ray_trace_by_householder() -> None:
    film = TrueFilm(37.0, ABERRATED)
    found = of(seen(height_of(film)))
    x, y = X[INSIDE], Y[INSIDE]
    axis = found.sphere.normal
    normals = film.normal(x, y)
    mirror = np.eye(3)[:, :, None] - 2 * np.einsum("in,jn->ijn", normals, normals)
    rays = np.einsum("ijn,j->in", mirror, -axis)
    start = np.stack([x, y, film.height(x, y)])

    def spot(f: float) -> np.ndarray:
        place = start + rays * ((f - axis @ start) / (axis @ rays))
        return np.linalg.norm(place - place.mean(axis=1, keepdims=True), axis=0)

    best = minimize_scalar(lambda f: np.sum(spot(f) ** 2), bracket=(1500, 1700), tol=1e-10).x
    assert found.numbers.best_focus_mm == pytest.approx(best, rel=1e-4)
    radii = spot(best)
    for share, radius in ((0.5, found.numbers.spot_50_mm), (0.8, found.numbers.spot_80_mm)):
        assert radius == pytest.approx(np.quantile(radii, share), rel=0.01)
    assert found.numbers.spot_rms_mm == pytest.approx(np.sqrt(np.mean(radii**2)), rel=0.01)


def test_the_spectrum_equals_that_of_prysm_and_shows_a_ripple() -> None:
    axis = np.linspace(
        -APERTURE, APERTURE, 160
    )  # an even number: prysm centres odd ones half a cell off
    x, y = np.meshgrid(axis, axis)
    inside = np.hypot(x, y) <= APERTURE
    height = np.where(inside, 1e-3 * np.cos(2 * np.pi * x / 50), np.nan)
    ripple = of(surface_map.SurfaceMap(axis, height, 0 * x, 0 * x))
    found = power_spectrum.power_spectrum(ripple, axis, APERTURE)
    assert 1 / found.frequency_per_mm[np.argmax(found.density_um2_mm2)] == pytest.approx(
        50, rel=0.03
    )
    window = np.where(inside, np.cos(np.pi / 2 * np.minimum(np.hypot(x, y) / APERTURE, 1)) ** 2, 0)
    values = np.where(inside, ripple.deviation_um, 0)
    values = values - np.sum(window * values) / np.sum(window)
    fx, fy, density = interferogram.psd(values, float(axis[1] - axis[0]), window)
    ring = np.abs(np.hypot(*np.broadcast_arrays(fx, fy)) * 2 * APERTURE - 19) < 0.5
    mine = found.density_um2_mm2[np.argmin(np.abs(found.frequency_per_mm - 0.02))]
    assert mine == pytest.approx(density[ring].mean(), rel=0.02)
    total = np.sum(2 * np.pi * found.frequency_per_mm * found.density_um2_mm2) / (2 * APERTURE)
    assert total == pytest.approx(0.5, rel=0.02)  # the mean square of a cosine


def test_error_bars_are_the_scatter_of_disturbed_surfaces() -> None:
    """Surfaces from the same covariance, drawn by other means and evaluated in full."""
    random = np.random.default_rng(7)
    root = np.zeros((ZERNIKE_TERMS, 3))
    root[[2, 3, 4, 10], [0, 1, 2, 1]] = 2e-3, 5e-3, 8e-3, 1e-3
    bowl = surface.Surface.hencky_bowl(37.0, 500.0)
    true = replace(
        bowl, coeffs_mm=bowl.coeffs_mm + 0.1 * np.eye(ZERNIKE_TERMS)[[4, 5, 6, 9]].sum(axis=0)
    )
    evaluate = quantities.FigureOf(seen(true.height(X, Y)), APERTURE)
    nominal = np.array(astuple(evaluate(seen(true.height(X, Y))).numbers))
    bars = bars_of(seen(true.height(X, Y)), root @ root.T)
    off = []
    for _ in range(40):
        moved = surface.Surface.from_parameters(
            true.parameters + root @ random.normal(size=3), 500.0
        )
        off.append(np.array(astuple(evaluate(seen(moved.height(X, Y))).numbers)) - nominal)
    scatter = np.sqrt(np.mean(np.square(off), axis=0))
    np.testing.assert_allclose(
        astuple(bars.numbers), scatter, rtol=0.4, atol=2e-3
    )  # rays: a grid's own grain
    noll = zernike_nm(2, 0, R / 500, THETA, norm=True)
    per_unit = np.polyfit((R[INSIDE] / APERTURE) ** 2, noll[INSIDE], 1)[0] / 2
    assert bars.fringe_um[3] == pytest.approx(1e3 * per_unit * 2e-3, rel=0.01)


def test_noise_of_cells_alone_widens_the_pv_of_a_perfect_sphere() -> None:
    noisy = bars_of(seen(ball(3400.0)), np.zeros((ZERNIKE_TERMS, ZERNIKE_TERMS)), 5e-6)
    step_um = 1e3 * float(AXIS[1] - AXIS[0])
    assert 0.1 * step_um < noisy.numbers.irregularity_pv_um / 5e-6 < 20 * step_um


def test_a_covariance_that_is_unknown_gives_no_error_bar() -> None:
    bars = bars_of(seen(ball(3400.0)), np.full((ZERNIKE_TERMS, ZERNIKE_TERMS), np.nan))
    assert np.isnan(astuple(bars.numbers)).all()
    assert np.isnan(bars.fringe_um).all()


@pytest.mark.parametrize(
    "part",
    [X > 0, R > 400, (R > 50) & (np.abs(X) > 30), np.random.default_rng(1).random(X.shape) < 0.03],
    ids=["half", "ring", "spider", "scattered"],
)
def test_a_figure_of_any_part_of_a_mirror(part: np.ndarray) -> None:
    height = np.where(part & INSIDE, ball(3400.0), np.nan)
    some = surface_map.SurfaceMap(AXIS, height, X / 3400, Y / 3400)
    assert of(some).numbers.radius_of_curvature_mm == pytest.approx(3400, rel=1e-6)
    bars = bars_of(some, 1e-12 * np.eye(ZERNIKE_TERMS), 1e-6)
    assert np.isfinite(astuple(bars.numbers)).all()
