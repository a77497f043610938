"""The twin's clear front film: one that does nothing, the gas, and the light of its images."""

from dataclasses import replace

import numpy as np
import pytest

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.front_film import FrontFilmConfig
from membrane_ctrl.config.optics import CameraConfig, MirrorConfig, OpticsConfig
from membrane_ctrl.sim.optics.bench_poses import camera_pose, pixel_directions, screen_pose
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.front_film import FrontFilm, gas_excess_of, make_front_film
from membrane_ctrl.sim.optics.trace import trace_rays
from membrane_ctrl.sim.optics.trace_cushion import CushionTrace, trace_cushion

OPTICS = OpticsConfig(
    camera=CameraConfig(width_px=153, height_px=128, pixel_um=55.2, noise_adu=0.0, bits=12),
    mirror=MirrorConfig(front_film=FrontFilmConfig()),
)
FILM = FilmShape(37.1)
FRONT = make_front_film(OPTICS.mirror, 37.1, None)


def trace(front: FrontFilm) -> CushionTrace:
    """Rays of every third pixel."""
    pose = camera_pose(OPTICS.geometry)
    columns, rows = np.meshgrid(np.arange(0.0, 153, 3), np.arange(0.0, 128, 3))
    directions = pixel_directions(OPTICS.camera, pose, columns.ravel(), rows.ravel())
    return trace_cushion(
        pose, directions, FILM.terms, 37.1, 0.0, front, screen_pose(OPTICS.geometry)
    )


def test_a_film_without_index_changes_no_ray() -> None:
    assert FRONT is not None
    pose = camera_pose(OPTICS.geometry)
    columns, rows = np.meshgrid(np.arange(0.0, 153, 3), np.arange(0.0, 128, 3))
    directions = pixel_directions(OPTICS.camera, pose, columns.ravel(), rows.ravel())
    alone = trace_rays(pose, directions, FILM.terms, 37.1, 0.0, screen_pose(OPTICS.geometry))
    through = trace(replace(FRONT, index=1.0, gas_excess=0.0)).main
    seen = alone.on_film(500.0)
    assert seen.sum() > 500
    assert through.s_x_mm[seen] == pytest.approx(alone.s_x_mm[seen], abs=1e-8)
    assert through.s_y_mm[seen] == pytest.approx(alone.s_y_mm[seen], abs=1e-8)


def test_the_gas_bends_the_rays_by_micrometres_on_the_screen() -> None:
    assert FRONT is not None
    through = trace(FRONT).main
    without = trace(replace(FRONT, gas_excess=0.0)).main
    seen = through.on_film(475.0)
    moved_um = 1e3 * np.hypot(through.s_x_mm - without.s_x_mm, through.s_y_mm - without.s_y_mm)
    assert 5 < moved_um[seen].max() < 30


def test_nitrogen_in_air_is_denser_optically_by_seven_millionths() -> None:
    assert gas_excess_of(FrontFilmConfig(), 600.0) == pytest.approx(7.1e-6, abs=0.3e-6)
    same_gas = gas_excess_of(FrontFilmConfig(gas="air"), 0.0)
    assert same_gas == 0.0
    assert gas_excess_of(FrontFilmConfig(gas="helium"), 600.0) < -2e-4


@pytest.mark.parametrize("pattern", [Pattern("white"), Pattern("crossed", "", 32)])
def test_the_middle_shows_the_screen_thrice(pattern: Pattern) -> None:
    """White: 0.81 of the light without a front film beside the images, 0.99 in both of them."""
    assert FRONT is not None
    alone = OpticsRenderer(OPTICS, FILM).render_picture(pattern, 0.0).astype(float)
    seen = OpticsRenderer(OPTICS, FILM, front=FRONT).render_picture(pattern, 0.0).astype(float)
    beside = (seen - 82)[64, 40] / (alone - 82)[64, 40]
    assert beside == pytest.approx(FRONT.transmittance**2, abs=0.01)
    if pattern.role == "white":
        ratio = (seen - 82)[60:68, 70:85] / (alone - 82)[60:68, 70:85]
        assert ratio.max() == pytest.approx(0.995, abs=0.01)
        middle = slice(50, 78), slice(60, 95)
        assert np.mean((seen - 0.808 * alone)[middle] > 60) > 0.1
    outside, inside = FRONT.image_shares
    assert (outside, inside) == pytest.approx((0.1148, 0.0726), abs=0.002)


def test_errors_of_mounting_follow_the_seed() -> None:
    one, same, other = (make_front_film(OPTICS.mirror, 37.1, seed) for seed in (1, 1, 2))
    assert one is not None
    assert other is not None
    assert one == same
    assert one.shape.sag_mm != other.shape.sag_mm
    assert abs(one.shape.sag_mm - 63.4) < 5
    assert one.shape.zernike_um != other.shape.zernike_um
    assert make_front_film(MirrorConfig(), 37.1, 1) is None
