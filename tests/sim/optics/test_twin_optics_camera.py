"""The twin's screen and camera in their roles."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from firmware_iface.optical_roles import Camera, Pattern, Screen
from firmware_iface.roles import LinkError
from membrane_ctrl.config.schema import OpticsConfig, TwinConfig
from membrane_ctrl.sim.optics.camera import OpticsRenderer, TwinOptics
from membrane_ctrl.sim.optics.film_shape import FilmShape


@dataclass
class Position:
    displacement_um: float
    sag_mm: float


@dataclass
class Bench:
    """A film placed by the test, and a stopped clock."""

    position: Position = field(default_factory=lambda: Position(-25.0, 37.075))
    time_s: float = 5.0

    def now(self) -> float:
        return self.time_s

    def truth(self) -> Position:
        return self.position


def _optics(optics: OpticsConfig, bench: Bench, film: FilmShape | None = None) -> TwinOptics:
    return TwinOptics(optics, TwinConfig(seed=3), bench.truth, bench, film)


def test_a_frame_shows_the_pattern_on_the_film_where_it_stands(
    clean_optics: OpticsConfig, film: FilmShape
) -> None:
    bench = Bench()
    twin = _optics(clean_optics, bench, film)
    screen: Screen = twin.screen
    camera: Camera = twin.camera
    screen.show(Pattern("sin", "x", 1, np.pi / 2))
    first = camera.grab()
    bench.position, bench.time_s = Position(40.0, 37.14), 6.5
    second = camera.grab()
    assert (first.time_s, second.time_s) == (5.0, 6.5)
    expected = OpticsRenderer(clean_optics, film, reference_um=-25.0)
    for frame, displacement_um in ((first, -25.0), (second, 40.0)):
        np.testing.assert_array_equal(
            frame.pixels,
            expected.render_picture(Pattern("sin", "x", 1, np.pi / 2), displacement_um),
        )
    assert (first.pixels != second.pixels).mean() > 0.3


def test_the_film_gets_its_sag_from_the_truth_and_its_figure_from_the_seed(
    small_optics: OpticsConfig,
) -> None:
    film = _optics(small_optics, Bench()).film
    assert film.sag_at_mm(-25.0) == pytest.approx(37.075)
    assert np.hypot(film.zernike_um[4], film.zernike_um[5]) == pytest.approx(300.0)


def test_a_stated_reference_is_kept(clean_optics: OpticsConfig, film: FilmShape) -> None:
    geometry = clean_optics.geometry.model_copy(update={"reference_displacement_um": 900.0})
    optics = clean_optics.model_copy(update={"geometry": geometry})
    twin = _optics(optics, Bench(), film)
    twin.screen.show(Pattern("sin", "y"))
    expected = OpticsRenderer(optics, film, reference_um=900.0).render_picture(
        Pattern("sin", "y"), -25.0
    )
    np.testing.assert_array_equal(twin.camera.grab().pixels, expected)


def test_frames_land_in_the_buffer(small_optics: OpticsConfig) -> None:
    twin = _optics(small_optics, Bench())
    twin.prepare()
    twin.screen.show(Pattern("white"))
    buffer = np.zeros((256, 306), np.uint8)
    assert twin.camera.grab(buffer).pixels is buffer
    assert buffer.max() > 150


def test_without_a_pattern_there_is_no_frame(small_optics: OpticsConfig) -> None:
    twin = _optics(small_optics, Bench())
    with pytest.raises(LinkError, match="shows nothing"):
        twin.camera.grab()
    twin.screen.show(Pattern("black"))
    twin.camera.grab()
    twin.screen.close()
    with pytest.raises(LinkError, match="shows nothing"):
        twin.camera.grab()


def test_a_closed_camera_raises(small_optics: OpticsConfig) -> None:
    twin = _optics(small_optics, Bench())
    twin.screen.show(Pattern("white"))
    twin.camera.close()
    with pytest.raises(LinkError, match="closed"):
        twin.camera.grab()
