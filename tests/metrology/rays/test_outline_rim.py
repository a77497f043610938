"""The rim in the picture against the camera's pose, and the radial profile against Hencky."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.metrology.figure.radial_profile import pressure_pa, radial_profile
from membrane_ctrl.metrology.film import hencky_bowl
from membrane_ctrl.metrology.rays.geometry import Geometry, project_points
from membrane_ctrl.metrology.rays.rim_outline import find_outline
from tests.support.rendered_sets import FILM, bench, good_set


def white_minus_black() -> np.ndarray:
    stack = good_set(bench(shrink=4))
    return stack.frames[-2].astype(float) - stack.frames[-1]


def test_the_rim_is_where_the_pose_puts_it() -> None:
    outline = find_outline(
        white_minus_black(), Geometry.from_config(bench(shrink=4)), 500.0, FILM.sag_mm
    )
    assert outline is not None
    assert outline.offset_mm < 2
    assert outline.size_ratio == pytest.approx(1.0, abs=0.005)


def test_a_camera_that_was_turned_is_seen() -> None:
    light = np.roll(white_minus_black(), (8, -12), axis=(0, 1))
    outline = find_outline(light, Geometry.from_config(bench(shrink=4)), 500.0, FILM.sag_mm)
    assert outline is not None
    shift = np.subtract(outline.centre_px, outline.expected_px)
    assert shift == pytest.approx([-12, 8], abs=1.0)


def test_the_rim_is_looked_for_through_the_lens() -> None:
    straight = bench(shrink=4)
    # 1 % at the rim, 0.19 from the axis: 5 mm on the mirror, were the lens not known
    camera = straight.camera.model_copy(update={"distortion": (-0.3, 0.05, 1e-3, -5e-4)})
    optics = straight.model_copy(update={"camera": camera})
    stack = good_set(optics)
    light = stack.frames[-2].astype(float) - stack.frames[-1]
    outline = find_outline(light, Geometry.from_config(optics), 500.0, FILM.sag_mm)
    assert outline is not None
    assert outline.offset_mm < 2
    assert outline.size_ratio == pytest.approx(1.0, abs=0.003)
    ignored = find_outline(light, Geometry.from_config(straight), 500.0, FILM.sag_mm)
    assert ignored is not None
    assert ignored.size_ratio < 0.995


def test_points_are_projected_along_their_rays() -> None:
    camera = bench().camera.model_copy(update={"distortion": (-0.12, 0.02, 1e-3, -5e-4)})
    geometry = Geometry.from_config(bench().model_copy(update={"camera": camera}))
    columns, rows = np.array([10.0, 150, 290]), np.array([12.0, 100, 240])
    there = geometry.pinhole_mm[:, None] + 2000 * geometry.rays(columns, rows)
    assert project_points(geometry, there) == pytest.approx(np.stack([columns, rows]), abs=1e-6)


def test_a_rim_that_is_half_outside_the_picture_is_found_by_its_other_half() -> None:
    optics = bench(shrink=4)
    column, row = optics.camera.principal
    aside = optics.camera.model_copy(update={"principal_px": (column + 150, row)})
    optics = optics.model_copy(update={"camera": aside})
    stack = good_set(optics)
    light = stack.frames[-2].astype(float) - stack.frames[-1]
    outline = find_outline(light, Geometry.from_config(optics), 500.0, FILM.sag_mm)
    assert outline is not None
    assert outline.offset_mm < 4
    assert outline.rim_px.shape[1] < 170


def test_no_rim_in_the_dark_or_in_even_light() -> None:
    geometry = Geometry.from_config(bench(shrink=4))
    assert find_outline(np.zeros((512, 612)), geometry, 500.0, 37.0) is None
    assert find_outline(np.full((512, 612), 80.0), geometry, 500.0, 37.0) is None


def test_the_vertex_projects_to_the_principal_point() -> None:
    geometry = Geometry.from_config(bench())
    assert project_points(geometry, np.zeros((3, 1)))[:, 0] == pytest.approx(geometry.principal_px)


def test_profile_of_a_hencky_bowl() -> None:
    axis = np.linspace(-475, 475, 191)
    x, y = np.meshgrid(axis, axis)
    r = np.hypot(x, y)
    height = 37.1 * hencky_bowl.bowl_profile(np.minimum(r / 500, 1.0)) + 0.1 * x / 475
    profile = radial_profile(axis, np.where(r <= 475, height, np.nan), 500.0)
    assert profile.sag_mm == pytest.approx(37.1, abs=1e-6)
    assert profile.pressure_pa == pytest.approx(600, rel=0.005)
    assert np.max(np.abs(profile.mean_mm - profile.hencky_mm)) < 0.02
    assert np.all(profile.low_mm <= profile.mean_mm)
    assert np.all(profile.mean_mm <= profile.high_mm)
    # the tilt is the band: 0.2 mm from end to end at the edge
    assert profile.high_mm[-1] - profile.low_mm[-1] == pytest.approx(0.2, abs=0.03)


def test_pressure_is_proportional_to_the_cube_of_the_sag() -> None:
    assert pressure_pa(2 * 37.1, 500.0) == pytest.approx(8 * pressure_pa(37.1, 500.0))
