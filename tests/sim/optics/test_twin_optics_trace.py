"""The exact ray trace, checked by physics and not by its own formulas."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from membrane_ctrl.config.optics import (
    CameraConfig,
    CameraPoseConfig,
    GeometryConfig,
    OpticsConfig,
    ScreenPoseConfig,
)
from membrane_ctrl.sim.optics.bench_poses import (
    ScreenError,
    ScreenPose,
    camera_pose,
    pixel_directions,
    screen_pose,
)
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.trace import Trace, trace_rays

A_MM, B_MM, ALPHA = 2672.0, 2871.0, np.radians(80.9)
GEOMETRY = OpticsConfig().geometry


def _world(pose: ScreenPose, hits: Trace) -> np.ndarray:
    flat = pose.origin_mm + np.outer(hits.s_x_mm, pose.s_x) + np.outer(hits.s_y_mm, pose.s_y)
    bow = pose.bow_per_mm * (hits.s_x_mm**2 + hits.s_y_mm**2)
    return np.asarray(flat + np.outer(bow, np.cross(pose.s_x, pose.s_y)))


def _rays(columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    return pixel_directions(CameraConfig(), camera_pose(GEOMETRY), columns, rows)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


@pytest.mark.parametrize("error", [None, ScreenError(1.0, -2.0, 3.0)])
def test_the_law_of_reflection_holds(film: FilmShape, error: ScreenError | None) -> None:
    rng = np.random.default_rng(1)
    columns, rows = rng.uniform(700.0, 1750.0, 300), rng.uniform(500.0, 1550.0, 300)
    camera, screen = camera_pose(GEOMETRY), screen_pose(GEOMETRY, error)
    directions = _rays(columns, rows)
    hits = trace_rays(camera, directions, film.terms, 37.2, -0.1, screen)
    assert hits.on_film(500.0).all()

    p = np.stack([hits.x_mm, hits.y_mm, film.height_mm(hits.x_mm, hits.y_mm, 100.0) - 0.1], axis=1)
    np.testing.assert_allclose(
        _unit(p - camera.position_mm), directions, atol=1e-14
    )  # on the camera's ray
    # slopes by a five-point difference of the heights, independent of the trace's own derivatives
    step, weights = 0.5, np.array([1.0, -8.0, 8.0, -1.0]) / 12.0
    offsets = np.array([-2.0, -1.0, 1.0, 2.0]) * step

    def slope(along_x: float, along_y: float) -> np.ndarray:
        heights = [
            film.height_mm(hits.x_mm + o * along_x, hits.y_mm + o * along_y, 100.0) for o in offsets
        ]
        return np.asarray(weights @ np.array(heights) / step)

    normal = _unit(np.stack([-slope(1, 0), -slope(0, 1), np.ones(300)], axis=1))
    bisector = _unit(_unit(camera.position_mm - p) + _unit(_world(screen, hits) - p))
    assert np.abs(np.cross(normal, bisector)).max() < 1e-12


def test_the_chief_ray_runs_from_f_over_o_to_its_end() -> None:
    c0, r0 = CameraConfig().principal
    hits = trace_rays(
        camera_pose(GEOMETRY),
        _rays(np.array([c0]), np.array([r0])),
        FilmShape(37.1).terms,
        37.1,
        0.0,
        screen_pose(GEOMETRY),
    )
    assert np.abs([hits.x_mm, hits.y_mm, hits.s_x_mm, hits.s_y_mm]).max() < 1e-10
    np.testing.assert_allclose(
        camera_pose(GEOMETRY).position_mm,
        [A_MM * np.cos(ALPHA), 0, A_MM * np.sin(ALPHA)],
        rtol=1e-15,
    )
    np.testing.assert_allclose(
        screen_pose(GEOMETRY).origin_mm,
        [-B_MM * np.cos(ALPHA), 0, B_MM * np.sin(ALPHA)],
        rtol=1e-15,
    )


def test_light_from_a_paraboloids_focus_leaves_parallel_to_its_axis() -> None:
    sag_mm, radius_mm = 37.1, 500.0
    focus_mm = radius_mm**2 / (4.0 * sag_mm)
    straight = GeometryConfig(
        camera=CameraPoseConfig(
            position_mm=(0, 0, focus_mm), rotation=((1, 0, 0), (0, -1, 0), (0, 0, -1))
        ),
        screen=ScreenPoseConfig(origin_mm=(0, 0, 3000), s_x=(-1, 0, 0), s_y=(0, 1, 0)),
    )
    camera = camera_pose(straight)
    angles = np.linspace(-0.2, 0.2, 21)
    tx, ty = (v.ravel() for v in np.meshgrid(angles, angles))
    directions = _unit(np.stack([tx, ty, -np.ones_like(tx)], axis=1))
    film = FilmShape(sag_mm, radius_mm, "paraboloid")
    hits = trace_rays(camera, directions, film.terms, sag_mm, 0.0, screen_pose(straight))
    np.testing.assert_allclose(hits.s_x_mm, -hits.x_mm, atol=1e-9)
    np.testing.assert_allclose(hits.s_y_mm, hits.y_mm, atol=1e-9)


def test_in_the_plane_y_0_s_x_is_the_papers_distance_to_a() -> None:
    """The paper's scalar equations, with tan(theta) = -dh/dx as the interfaces warn; no y slope in
    that plane.
    """
    flat_in_y = FilmShape(
        37.1, zernike_um=(0, 300.0, 0, 0, 0, 0, 0, 100.0)
    )  # even in y: stays in the plane
    columns = np.linspace(700.0, 1750.0, 40)
    rows = np.full(40, CameraConfig().principal[1])
    hits = trace_rays(
        camera_pose(GEOMETRY),
        _rays(columns, rows),
        flat_in_y.terms,
        37.1,
        0.0,
        screen_pose(GEOMETRY),
    )
    x, h = hits.x_mm, flat_in_y.height_mm(hits.x_mm, hits.y_mm)
    step = 1e-2
    dh = (flat_in_y.height_mm(x + step, 0 * x) - flat_in_y.height_mm(x - step, 0 * x)) / (2 * step)
    theta = np.arctan(-dh)
    mu = np.arctan2(A_MM * np.sin(ALPHA) - h, A_MM * np.cos(ALPHA) - x)
    gap = ALPHA - mu
    o_b = (A_MM + B_MM) * np.tan(gap)
    e_b = 2.0 * h * np.cos(mu) / np.cos(gap)
    p_e = (
        h * np.cos(2 * mu) / np.sin(mu)
        + (A_MM + B_MM) / np.cos(gap)
        - A_MM * np.sin(ALPHA) / np.sin(mu)
        - h * np.sin(2 * mu) / (np.tan(np.pi / 2 - gap) * np.sin(mu))
    )
    a_e = p_e * np.tan(2 * theta) / (np.tan(2 * theta) * np.sin(gap) + np.cos(gap))
    np.testing.assert_allclose(hits.s_x_mm, o_b - e_b - a_e, atol=1e-5)
    np.testing.assert_allclose(hits.s_y_mm, 0.0, atol=1e-10)


def test_the_picture_is_upright() -> None:
    c0, r0 = CameraConfig().principal
    hits = trace_rays(
        camera_pose(GEOMETRY),
        _rays(np.array([c0 + 500, c0]), np.array([r0, r0 - 500])),
        FilmShape(37.1).terms,
        37.1,
        0.0,
        screen_pose(GEOMETRY),
    )
    assert hits.x_mm[0] > 200.0  # image right is world +x
    assert hits.y_mm[1] > 200.0  # row 0, on top, is world +y


def test_a_flat_film_shows_the_screen_as_a_plane_mirror_does() -> None:
    columns, rows = np.array([1000.0, 1400.0]), np.array([1200.0, 900.0])
    hits = trace_rays(
        camera_pose(GEOMETRY),
        _rays(columns, rows),
        FilmShape(0.0).terms,
        0.0,
        0.0,
        screen_pose(GEOMETRY),
    )
    # the mirrored pinhole (z reversed), the point on the film and the point on the screen are in
    # one line
    mirrored = camera_pose(GEOMETRY).position_mm * [1, 1, -1]
    on_film = np.stack([hits.x_mm, hits.y_mm, [0.0, 0.0]], axis=1)
    on_screen = _world(screen_pose(GEOMETRY), hits)
    assert np.abs(np.cross(_unit(on_film - mirrored), _unit(on_screen - mirrored))).max() < 1e-14


def test_the_general_form_of_the_short_geometry_gives_the_same_rays(
    small_optics: OpticsConfig, film: FilmShape
) -> None:
    camera, screen = camera_pose(GEOMETRY), screen_pose(GEOMETRY)
    general = GeometryConfig(
        camera=CameraPoseConfig(
            position_mm=tuple(camera.position_mm), rotation=tuple(map(tuple, camera.rotation))
        ),
        screen=ScreenPoseConfig(
            origin_mm=tuple(screen.origin_mm), s_x=tuple(screen.s_x), s_y=tuple(screen.s_y)
        ),
    )
    short = OpticsRenderer(small_optics, film).trace_pixels(20.0)
    long = OpticsRenderer(small_optics.model_copy(update={"geometry": general}), film).trace_pixels(
        20.0
    )
    np.testing.assert_allclose(long.s_x_mm, short.s_x_mm, atol=1e-12)
    np.testing.assert_allclose(long.s_y_mm, short.s_y_mm, atol=1e-12)


def test_the_vertex_moves_away_when_the_bowl_deepens(
    clean_optics: OpticsConfig, film: FilmShape
) -> None:
    """The ring does not move: at displacement d the vertex is at -(d - reference), which a moved
    world shows too.
    """
    raised = OpticsRenderer(clean_optics, film, reference_um=150.0).trace_pixels(150.0)
    same = OpticsRenderer(clean_optics, film, reference_um=0.0).trace_pixels(150.0)
    on = raised.on_film(490.0)
    camera = camera_pose(clean_optics.geometry)
    for hits, vertex_z in ((raised, 0.0), (same, -0.150)):
        z = vertex_z + film.height_mm(hits.x_mm[on], hits.y_mm[on], 150.0)
        p = np.stack([hits.x_mm[on], hits.y_mm[on], z], axis=1)
        columns, rows = np.meshgrid(np.arange(306.0), np.arange(256.0))
        directions = pixel_directions(
            clean_optics.camera, camera, columns.ravel()[on], rows.ravel()[on]
        )
        np.testing.assert_allclose(_unit(p - camera.position_mm), directions, atol=1e-14)


@pytest.mark.parametrize(
    "coeffs", [(-0.12, 0.05, 1e-3, -5e-4), (-0.1, 0.02, 0.0, 1e-3, 0.01, 0.02, 0.01, -0.01)]
)
def test_lens_distortion_is_opencvs(coeffs: tuple[float, ...]) -> None:
    camera = CameraConfig(distortion=coeffs)
    pose = camera_pose(GEOMETRY)
    columns, rows = (
        v.ravel() for v in np.meshgrid(np.linspace(0, 2447, 9), np.linspace(0, 2047, 7))
    )
    in_camera = pixel_directions(camera, pose, columns, rows) @ pose.rotation.T
    focal_px = camera.focal_mm * 1000.0 / camera.pixel_um
    c0, r0 = camera.principal
    matrix = np.array([[focal_px, 0, c0], [0, focal_px, r0], [0, 0, 1]])
    back, _ = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), matrix, np.array(coeffs))
    np.testing.assert_allclose(back[:, 0, :], np.stack([columns, rows], axis=1), atol=1e-9)


def test_a_lens_that_folds_the_picture_is_refused() -> None:
    with pytest.raises(ValueError, match=r"camera\.distortion"):
        pixel_directions(
            CameraConfig(distortion=(-8.0, 0.0, 0.0, 0.0)),
            camera_pose(GEOMETRY),
            np.array([0.0]),
            np.array([0.0]),
        )


def test_a_screen_behind_the_film_is_never_reached() -> None:
    behind = ScreenPose(
        np.array([0.0, 0.0, -1000.0]), np.array([-1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    )
    c0, r0 = CameraConfig().principal
    hits = trace_rays(
        camera_pose(GEOMETRY),
        _rays(np.array([c0]), np.array([r0])),
        FilmShape(37.1).terms,
        37.1,
        0.0,
        behind,
    )
    assert np.isnan(hits.s_x_mm[0])
    assert np.isnan(hits.s_y_mm[0])


def test_rays_beside_the_film_are_not_on_it() -> None:
    hits = trace_rays(
        camera_pose(GEOMETRY),
        _rays(np.array([5.0]), np.array([5.0])),
        FilmShape(37.1).terms,
        37.1,
        0.0,
        screen_pose(GEOMETRY),
    )
    assert not hits.on_film(500.0)[0]


def test_rays_that_look_up_never_meet_the_film() -> None:
    up = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    hits = trace_rays(
        camera_pose(GEOMETRY), up, FilmShape(37.1).terms, 37.1, 0.0, screen_pose(GEOMETRY)
    )
    assert np.isnan(hits.x_mm).all()
    assert not hits.on_film(500.0).any()


def test_a_bowed_screen_stands_off_towards_the_mirror() -> None:
    pose = screen_pose(GEOMETRY, ScreenError(bow_mm=2.0))
    assert pose.bow_per_mm * 200.0**2 == pytest.approx(2.0)
    assert np.dot(np.cross(pose.s_x, pose.s_y), -pose.origin_mm) > 0.0
