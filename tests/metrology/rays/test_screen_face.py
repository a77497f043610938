"""A screen that is no plane: heights of the map, rays to it, and the figure with and without it."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.config.optics import (
    CameraPoseConfig,
    GeometryConfig,
    HeightMapConfig,
    OpticsConfig,
    ScreenPoseConfig,
)
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.figure.pixel_figure import measure_pixels, reconstruct_full
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.rays.bench_poses import BenchGeometry
from membrane_ctrl.metrology.rays.forward_model import residual_mm
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer
from membrane_ctrl.metrology.rays.screen_face import Face
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.uncertainty.geometry_spread import GENERAL_NAMES, change_geometry
from membrane_ctrl.sim.optics.bench_poses import camera_pose, screen_pose
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.trace import trace_rays
from tests.support.metrology_truth import SMALL, pixel_grid
from tests.support.rendered_sets import FILM, bench, good_set

RNG = np.random.default_rng(5)
NODES_X, NODES_Y = np.linspace(-250, 250, 6), np.linspace(-210, 240, 5)
MAP = HeightMapConfig(
    s_x_mm=tuple(NODES_X),
    s_y_mm=tuple(NODES_Y),
    heights_mm=tuple(tuple(row) for row in RNG.normal(0, 0.5, (5, 6))),
)
CROOKED = ScreenPoseConfig(bow_mm=0.8, height_map=MAP)


def _optics(screen: ScreenPoseConfig | None) -> OpticsConfig:
    optics = bench(noise_adu=0.0)
    return optics.model_copy(
        update={"geometry": optics.geometry.model_copy(update={"screen": screen})}
    )


def _map(x: np.ndarray, y: np.ndarray, heights: np.ndarray) -> HeightMapConfig:
    rows = tuple(tuple(row) for row in heights)
    return HeightMapConfig(s_x_mm=tuple(x), s_y_mm=tuple(y), heights_mm=rows)


def _error_um(surface: Surface) -> float:
    """RMS over the film's inner 470 mm."""
    x, y = np.meshgrid(*[np.linspace(-470, 470, 41)] * 2)
    inside = np.hypot(x, y) < 470
    return float(1e3 * np.std((surface.height(x, y) - FILM.height_mm(x, y))[inside]))


def test_the_map_passes_through_its_nodes_and_a_cubic_is_exact() -> None:
    x, y = np.meshgrid(NODES_X, NODES_Y)
    face = Face.from_config(ScreenPoseConfig(height_map=MAP))
    assert face.heights(np.stack([x, y]))[0] == pytest.approx(np.array(MAP.heights_mm), abs=1e-12)

    def cubic(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(1e-7 * a**3 - 2e-5 * a * b + 3e-8 * b**3 + 1e-3 * b)

    face = Face.from_config(ScreenPoseConfig(height_map=_map(NODES_X, NODES_Y, cubic(x, y))))
    a, b = RNG.uniform(-200, 200, (2, 50))
    w, by_a, by_b = face.heights(np.stack([a, b]))
    assert w == pytest.approx(cubic(a, b), abs=1e-11)
    assert by_a == pytest.approx(3e-7 * a**2 - 2e-5 * b, abs=1e-12)
    assert by_b == pytest.approx(9e-8 * b**2 - 2e-5 * a + 1e-3, abs=1e-12)


def test_few_nodes_make_a_bow_or_a_plane() -> None:
    points = RNG.uniform(-190, 190, (2, 40))
    x, y = np.meshgrid([-200.0, 0, 200], [-200.0, 0, 200])
    bowed = Face.from_config(
        ScreenPoseConfig(height_map=_map(x[0], y[:, 0], 1.5 * (x**2 + y**2) / 200**2))
    )
    assert bowed.heights(points) == pytest.approx(
        Face.from_config(ScreenPoseConfig(bow_mm=1.5)).heights(points), abs=1e-12
    )
    tilted = Face.from_config(
        ScreenPoseConfig(height_map=_map(np.array([-200.0, 200]), y[:, 0], 0.01 * x[:, ::2]))
    )
    assert tilted.heights(points)[0] == pytest.approx(0.01 * points[0], abs=1e-12)


def test_beyond_the_map_the_height_of_its_edge_continues() -> None:
    face = Face.from_config(ScreenPoseConfig(height_map=MAP))
    edge, beyond = face.heights(np.array([[250.0, 400.0], [30.0, 30.0]])).T
    assert beyond[0] == pytest.approx(edge[0])
    assert beyond[1] == 0
    assert beyond[2] == pytest.approx(edge[2])


def test_rays_meet_the_face_where_the_twin_has_them() -> None:
    optics = _optics(CROOKED)
    geometry = Geometry.from_config(optics)
    rays = geometry.rays(*pixel_grid(SMALL, stride=3))
    seen = trace_rays(
        camera_pose(optics.geometry),
        rays.T,
        FilmShape(37.1).terms,
        37.1,
        0.0,
        screen_pose(optics.geometry),
    )
    inside = seen.on_film(475.0)
    points = Points.from_rays(rays[:, inside], np.zeros((2, int(inside.sum()))))
    tracer, surface = Tracer(geometry, 500.0), Surface.hencky_bowl(37.1, 500.0)
    tracer.place_on_shape(points, surface.height)
    tracer.intersect(points, surface, newton=3)
    found = tracer.predict_screen(points, surface)
    there = np.stack([seen.s_x_mm, seen.s_y_mm])[:, inside]
    assert np.abs(found - there).max() < 1e-9
    # the film's slope measured from there is the film's
    points.screen_mm[:] = there
    field = tracer.slope_field(points, surface)
    assert np.abs(field[2:4] - field[4:6]).max() < 1e-12


def test_the_calibration_follows_rays_to_the_same_face() -> None:
    geometry = Geometry.from_config(_optics(CROOKED))
    surface, tracer = Surface.hencky_bowl(37.1, 500.0), Tracer(geometry, 500.0)
    columns, rows = pixel_grid(SMALL, stride=5)
    rays = geometry.rays(columns, rows)
    plane = geometry.pinhole_mm[:2, None] - geometry.pinhole_mm[2] * rays[:2] / rays[2]
    inside = np.hypot(*plane) < 450
    points = Points.from_rays(rays[:, inside], np.zeros((2, int(inside.sum()))))
    tracer.place_on_shape(points, surface.height)
    tracer.intersect(points, surface, newton=3)
    seen = tracer.predict_screen(points, surface)
    phases = SetPhases("set", columns[inside], rows[inside], seen, np.ones(inside.sum()), 0.0)
    assert np.abs(residual_mm(BenchGeometry(geometry), phases, surface, 0.0)).max() < 1e-9


def test_world_points_lie_on_the_face() -> None:
    geometry = Geometry.from_config(_optics(ScreenPoseConfig(bow_mm=2.0)))
    point = geometry.screen_points(np.array([[200.0], [0.0]]))[:, 0]
    off = point - geometry.screen_origin_mm
    assert off @ geometry.screen_s_x == pytest.approx(200.0)
    towards_mirror = -geometry.screen_origin_mm / np.linalg.norm(geometry.screen_origin_mm)
    assert off @ towards_mirror == pytest.approx(2.0)


def test_the_full_result_needs_the_face_and_gets_it() -> None:
    truth = _optics(CROOKED)
    stack = good_set(truth)
    errors = []
    for optics in (truth, _optics(None)):
        checked = check_set(stack, optics)
        full = reconstruct_full(optics, checked, measure_pixels(optics, checked))
        errors.append(_error_um(full.surface))
    assert errors[0] < 0.1  # µm: rounding to 8 bits at a 64th of the pixels
    assert errors[1] > 20 * errors[0]


def test_the_live_cycle_has_the_face() -> None:
    optics = _optics(CROOKED)
    stack = good_set(optics)
    nan = np.full(len(stack.frames), np.nan)
    estimate = LiveReconstructor(optics, bin_px=2).measure_full(list(stack.frames), nan, nan)
    assert estimate.verdict == "ok"
    assert _error_um(Surface(estimate.coeffs_um / 1e3, estimate.hencky_um / 1e3, 500.0)) < 0.2


def test_both_forms_of_the_geometry_carry_the_face() -> None:
    short = GeometryConfig(a_mm=2672.0, b_mm=2871.0, alpha_deg=90.0, screen=CROOKED)
    assert change_geometry(short, ("a_mm",), [1.0]).screen == CROOKED
    camera = CameraPoseConfig(
        position_mm=(0, 0, 2672), rotation=((1, 0, 0), (0, -1, 0), (0, 0, -1))
    )
    posed = CROOKED.model_copy(
        update={"origin_mm": (0, 0, 2871), "s_x": (-1, 0, 0), "s_y": (0, 1, 0)}
    )
    moved = change_geometry(
        GeometryConfig(camera=camera, screen=posed), GENERAL_NAMES, np.full(12, 0.01)
    ).screen
    assert moved is not None
    assert (moved.bow_mm, moved.height_map) == (0.8, MAP)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"s_x_mm": (-250.0, 0.0, 249.0, 300.0, 400.0, 500.0)}, "s_x_mm must rise in even steps"),
        ({"s_y_mm": tuple(NODES_Y[::-1])}, "s_y_mm must rise"),
        (
            {"heights_mm": ((0.0,) * 6,) * 4},
            "4 rows of 6 numbers; s_y_mm and s_x_mm require 5 rows of 6",
        ),
        ({"heights_mm": ((800.0,) * 6,) * 5}, "beyond 100 mm"),
    ],
)
def test_a_map_that_is_no_grid_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HeightMapConfig(**{**MAP.model_dump(), **change})  # type: ignore[arg-type]


def test_a_map_must_reach_over_the_pattern() -> None:
    small = _map(NODES_X / 2, NODES_Y / 2, np.array(MAP.heights_mm))
    with pytest.raises(ValueError, match=r"height_map must reach over the pattern, 199\.28 mm"):
        OpticsConfig(
            geometry=GeometryConfig(
                a_mm=2672, b_mm=2871, alpha_deg=80.9, screen={"height_map": small}
            )
        )


def test_half_a_pose_is_refused() -> None:
    with pytest.raises(ValueError, match="give all or none"):
        ScreenPoseConfig(origin_mm=(0, 0, 2871))
    with pytest.raises(ValueError, match="give either a_mm"):
        GeometryConfig(
            a_mm=2672,
            b_mm=2871,
            alpha_deg=80.9,
            screen={"origin_mm": (0, 0, 1), "s_x": (1, 0, 0), "s_y": (0, 1, 0)},
        )
