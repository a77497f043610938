"""An unstated front film is named by every kind of set and of live figure, as far as it shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.front_film import FrontFilmConfig
from membrane_ctrl.config.optics import CameraConfig, MirrorConfig, OpticsConfig
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.frame_checks.checked_set import Anchor, Checked
from membrane_ctrl.metrology.frame_checks.film_image import NO_FILM_IMAGE, ImageEvidence
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.phase.pattern_sequence import full_sequence
from membrane_ctrl.metrology.tracking.live_tracker import LiveTracker
from membrane_ctrl.model.arrays import Image
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.front_film import make_front_film

CAMERA = CameraConfig(width_px=306, height_px=256, pixel_um=27.6, noise_adu=0.4, bits=12)
CUSHION = OpticsConfig(camera=CAMERA, mirror=MirrorConfig(front_film=FrontFilmConfig()))
SINGLE = OpticsConfig(camera=CAMERA)
FILM = typical_film(37.1, 500.0, 1)
PATTERNS = tuple(full_sequence(SINGLE.pattern))


def renderer_of(has_front_film: bool) -> OpticsRenderer:
    if not has_front_film:
        return OpticsRenderer(SINGLE, FILM, seed=1)
    front = make_front_film(CUSHION.mirror, 37.1, 1)
    return OpticsRenderer(CUSHION, FILM, front=front, seed=1)


@pytest.fixture(scope="module", params=[True, False], ids=["front film", "single"])
def frames(request: pytest.FixtureRequest) -> tuple[bool, list[Image]]:
    renderer = renderer_of(request.param)
    return request.param, [renderer.render_picture(p, 0.0) for p in PATTERNS]


def check(frames: list[Image], anchor: Anchor | None = None) -> Checked:
    """A full set, or its fringes alone with the orders of an anchor."""
    chosen = [k for k, pattern in enumerate(PATTERNS) if anchor is None or pattern.role == "sin"]
    pictures: Image = np.asarray([frames[k] for k in chosen])
    patterns = tuple(PATTERNS[k] for k in chosen)
    stack = FrameStack(pictures, patterns, np.zeros(len(chosen)), {})
    return check_set(stack, SINGLE, anchor)


def test_fringes_are_degraded_by_their_reference(frames: tuple[bool, list[Image]]) -> None:
    has_film, pictures = frames
    anchor = check(pictures).make_anchor()
    verdict, reason = check(pictures, anchor).verdict
    assert (verdict == "degraded") == has_film
    assert ("a second reflection of the screen at" in reason) == has_film


def test_without_white_and_black_the_mean_light_is_searched(
    frames: tuple[bool, list[Image]],
) -> None:
    has_film, pictures = frames
    anchor = replace(check(pictures).make_anchor(), image=NO_FILM_IMAGE)
    checked = check(pictures, anchor)
    assert checked.image.evidence is ImageEvidence.MEAN_LIGHT
    verdict, reason = checked.verdict
    assert (verdict == "degraded") == has_film
    assert ("a second reflection of the screen, or of a lamp, at" in reason) == has_film


def test_tracked_frames_are_degraded_by_their_reference(frames: tuple[bool, list[Image]]) -> None:
    has_film, pictures = frames
    renderer = renderer_of(has_film)
    tracker = LiveTracker(SINGLE, LiveReconstructor(SINGLE, 1), 16, step_s=0.2)
    tracker.measure_full(pictures, np.arange(18.0), np.zeros(18))
    tracked = tracker.measure_fringes(
        [renderer.render_picture(tracker.pattern, 0.0)], np.array([20.0]), np.zeros(1)
    )
    assert tracked.verdict == ("degraded" if has_film else "ok"), tracked.reason
    assert ("a second reflection of the screen" in tracked.reason) == has_film
