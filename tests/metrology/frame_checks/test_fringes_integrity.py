"""Fringes alone: their frames are checked against the reference's fringe orders and light; lenses
that distort.
"""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.metrology.frame_checks.checked_set import Anchor, RejectedSetError
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.rays.surface import Surface
from tests.support.rendered_sets import FILM, bench, faulty_set, good_set

X, Y = np.meshgrid(*[np.linspace(-475, 475, 61)] * 2)
INSIDE = np.hypot(X, Y) <= 475


@pytest.fixture(scope="module")
def anchor() -> Anchor:
    return check_set(good_set(bench()), bench()).make_anchor()


def fringes_of(stack: FrameStack) -> FrameStack:
    """The sinusoids alone."""
    kept = [k for k, p in enumerate(stack.patterns) if p.role == "sin"]
    return FrameStack(
        stack.frames[kept], tuple(stack.patterns[k] for k in kept), stack.displacement_um[kept], {}
    )


def error_um(surface: Surface) -> float:
    return float(np.std((surface.height(X, Y) - FILM.height_mm(X, Y))[INSIDE]) * 1e3)


@pytest.mark.parametrize("frame", ["x_sin_1", "y_sin_2"])
@pytest.mark.parametrize("kind", ["stale", "swapped", "flicker", "dark", "moved", "saturated"])
def test_a_bad_frame_of_a_fringes_set_is_reported(anchor: Anchor, kind: str, frame: str) -> None:
    stack = fringes_of(faulty_set(kind, frame))
    checked = check_set(stack, bench(), anchor)
    other = {"x_sin_1": "x_sin_2", "y_sin_2": "y_sin_3"}[frame]
    flagged = {stack.patterns[flag.frame].name for flag in checked.flags}
    assert flagged == ({frame, other} if kind == "swapped" else {frame})
    assert error_um(checked.state.surface) < 0.05


def test_a_film_that_moved_too_far_requires_a_full_set(anchor: Anchor) -> None:
    moved = fringes_of(good_set(bench(), motion_um=lambda _t: 2500.0))
    with pytest.raises(RejectedSetError, match="half a period from the reference"):
        check_set(moved, bench(), anchor)


def test_a_lens_that_distorts() -> None:
    small = bench().camera.model_dump(exclude_none=True)
    camera = CameraConfig(**{**small, "distortion": (-0.08, 0.02, 0.001, -0.0005)})
    optics = OpticsConfig(camera=camera)
    checked = check_set(good_set(optics), optics)
    assert checked.flags == ()
    assert error_um(checked.state.surface) < 0.05
