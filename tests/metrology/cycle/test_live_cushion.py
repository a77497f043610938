"""Live cycles of a mirror behind a front film, stated and not."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.config.front_film import FrontFilmConfig
from membrane_ctrl.config.optics import CameraConfig, MirrorConfig, OpticsConfig
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.phase.pattern_sequence import full_sequence
from membrane_ctrl.model.arrays import Image
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.front_film import make_front_film

CAMERA = CameraConfig(width_px=612, height_px=512, pixel_um=13.8, noise_adu=0.4, bits=12)
CUSHION = OpticsConfig(camera=CAMERA, mirror=MirrorConfig(front_film=FrontFilmConfig()))
SINGLE = OpticsConfig(camera=CAMERA)
FILM = typical_film(37.1, 500.0, 1)


@pytest.fixture(scope="module")
def frames() -> list[Image]:
    front = make_front_film(CUSHION.mirror, 37.1, 1)
    renderer = OpticsRenderer(CUSHION, FILM, front=front, seed=1)
    return [renderer.render_picture(p, 0.0) for p in full_sequence(CUSHION.pattern)]


def sag_error_um(optics: OpticsConfig, frames: list[Image]) -> tuple[float, str, str]:
    cycle = LiveReconstructor(optics, 4)
    estimate = cycle.measure_full(frames, np.arange(18.0), np.zeros(18))
    angle = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    rim_mm = FILM.height_mm(500 * np.cos(angle), 500 * np.sin(angle))
    return estimate.sag_um - 1e3 * float(rim_mm.mean()), estimate.verdict, estimate.reason


def test_a_stated_front_film_does_not_change_the_sag(frames: list[Image]) -> None:
    error_um, verdict, reason = sag_error_um(CUSHION, frames)
    assert abs(error_um) < 0.05
    assert verdict == "ok", reason


def test_one_that_is_not_stated_is_named(frames: list[Image]) -> None:
    error_um, verdict, reason = sag_error_um(SINGLE, frames)
    assert abs(error_um) > 0.2
    assert verdict == "degraded"
    assert "a second reflection of the screen" in reason


def test_a_single_film_is_not_blamed() -> None:
    renderer = OpticsRenderer(SINGLE, FILM, seed=1)
    frames = [renderer.render_picture(p, 0.0) for p in full_sequence(SINGLE.pattern)]
    error_um, verdict, reason = sag_error_um(SINGLE, frames)
    assert abs(error_um) < 0.05
    assert verdict == "ok", reason
