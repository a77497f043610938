"""Poses and rays in the world's frame."""

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
from membrane_ctrl.metrology.rays.geometry import Geometry

OPTICS = OpticsConfig()
GEOMETRY = Geometry.from_config(OPTICS)
COLUMN, ROW = OPTICS.camera.principal


def test_axis_goes_through_the_vertex() -> None:
    ray = GEOMETRY.rays(COLUMN, ROW)
    assert np.cross(ray, GEOMETRY.pinhole_mm) == pytest.approx(0, abs=1e-9)
    assert np.linalg.norm(GEOMETRY.pinhole_mm) == pytest.approx(2672)


def test_image_right_is_plus_x_and_image_down_is_minus_y() -> None:
    right, down = GEOMETRY.rays(COLUMN + 100, ROW), GEOMETRY.rays(COLUMN, ROW + 100)
    t = [-GEOMETRY.pinhole_mm[2] / ray[2] for ray in (right, down)]
    assert (GEOMETRY.pinhole_mm + t[0] * right)[0] > 10
    assert (GEOMETRY.pinhole_mm + t[1] * down)[1] < -10


def test_screen_is_across_the_line_to_the_vertex() -> None:
    origin, s_x, s_y = GEOMETRY.screen_origin_mm, GEOMETRY.screen_s_x, GEOMETRY.screen_s_y
    assert np.linalg.norm(origin) == pytest.approx(2871)
    assert (origin @ s_x, origin @ s_y) == pytest.approx((0, 0), abs=1e-9)
    assert s_x[0] < -0.9  # left to right for a viewer at the mirror is towards world -x
    assert GEOMETRY.screen_points(np.array([[10.0], [-3.0]]))[:, 0] == pytest.approx(
        origin + 10 * s_x - 3 * s_y
    )


def test_general_form_of_the_short_one_is_the_same() -> None:
    general = GeometryConfig(
        camera=CameraPoseConfig(
            position_mm=tuple(GEOMETRY.pinhole_mm),
            rotation=tuple(tuple(row) for row in GEOMETRY.rotation),
        ),
        screen=ScreenPoseConfig(
            origin_mm=tuple(GEOMETRY.screen_origin_mm),
            s_x=tuple(GEOMETRY.screen_s_x),
            s_y=tuple(GEOMETRY.screen_s_y),
        ),
    )
    other = Geometry.from_config(OPTICS.model_copy(update={"geometry": general}))
    assert other.rays(12.0, 700.0) == pytest.approx(GEOMETRY.rays(12.0, 700.0), abs=1e-15)


@pytest.mark.parametrize(
    "distortion", [(-0.1, 0.02, 1e-3, -5e-4), (0.05, 0.01, 0, 0, -0.003, 0.01, 0, 0)]
)
def test_distorted_pixels_go_back_where_opencv_puts_them(distortion: tuple[float, ...]) -> None:
    camera = CameraConfig(distortion=distortion)
    geometry = Geometry.from_config(OpticsConfig(camera=camera))
    columns, rows = np.array([0.0, 2447, 1000, 40]), np.array([0.0, 2047, 1900, 1024])
    rays = geometry.rotation @ geometry.rays(columns, rows)
    f = geometry.focal_px
    matrix = np.array([[f, 0, COLUMN], [0, f, ROW], [0, 0, 1]])
    pixels, _ = cv2.projectPoints(
        (rays / rays[2]).T, np.zeros(3), np.zeros(3), matrix, np.array(distortion)
    )
    assert np.abs(pixels[:, 0].T - np.stack([columns, rows])).max() < 1e-7


def test_a_pose_that_is_no_rotation_is_refused() -> None:
    with pytest.raises(ValueError, match="not a rotation"):
        CameraPoseConfig(position_mm=(0, 0, 2672), rotation=((1, 0, 0), (0, 1, 0), (0, 0, -1)))
    with pytest.raises(ValueError, match="unit vectors"):
        ScreenPoseConfig(origin_mm=(0, 0, 2871), s_x=(-2, 0, 0), s_y=(0, 1, 0))


def test_a_lens_that_folds_the_picture_has_no_rays_there() -> None:
    folding = Geometry.from_config(
        OpticsConfig(camera=CameraConfig(distortion=(-3.0, 0.0, 0.0, 0.0)))
    )
    assert np.isnan(folding.rays(0.0, 0.0)).all()
    assert folding.rays(COLUMN, ROW) == pytest.approx(GEOMETRY.rays(COLUMN, ROW))
