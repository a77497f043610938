"""Pictures or a pattern that are turned or mirrored against the stated bench are named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.frame_checks import picture_orientation
from membrane_ctrl.metrology.frame_checks.checked_set import Checked, RejectedSetError
from membrane_ctrl.metrology.frame_checks.picture_orientation import (
    SUSPICIOUS_URAD,
    find_orientation,
)
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.sim.optics.film_shape import FilmShape, Wrinkle
from tests.support.rendered_sets import bench, good_set

Image = NDArray[np.uint8]


def residual_urad(checked: Checked) -> float:
    """RMS of measured minus fitted slopes of the bins, µrad."""
    field = checked.tracer.slope_field(checked.state.points, checked.state.surface)
    return 1e6 * float(np.sqrt(np.mean(np.square(field[2:4] - field[4:6]))))


def rotate_quarter(picture: Image, quarters: int) -> Image:
    """A camera rotated by quarters of a turn counter-clockwise, seen by the same sensor."""
    return on_sensor(np.rot90(picture, quarters), picture.shape)


def on_sensor(picture: Image, shape: tuple[int, ...]) -> Image:
    """The middle of a picture on a sensor of another format; dark where it shows nothing."""
    out = np.zeros(shape, picture.dtype)
    size = np.minimum(shape, picture.shape)
    to, of = (np.array(shape) - size) // 2, (np.array(picture.shape) - size) // 2
    out[to[0] : to[0] + size[0], to[1] : to[1] + size[1]] = picture[
        of[0] : of[0] + size[0], of[1] : of[1] + size[1]
    ]
    return out


TURNED: dict[str, Callable[[Image], Image]] = {
    "the pictures are rotated by 180 degrees": lambda picture: picture[::-1, ::-1],
    "the pictures are mirrored left to right": lambda picture: picture[:, ::-1],
    "the pictures are mirrored top to bottom": lambda picture: picture[::-1],
    "the pictures are rotated by 90 degrees counter-clockwise": lambda p: rotate_quarter(p, 1),
    "the pictures are rotated by 90 degrees clockwise": lambda p: rotate_quarter(p, 3),
    "the pictures are shown with columns and rows exchanged": lambda p: on_sensor(p.T, p.shape),
}


def turned(stack: FrameStack, turn: Callable[[Image], Image]) -> FrameStack:
    """The set by a camera whose pictures are turned."""
    return replace(stack, frames=np.stack([turn(frame) for frame in stack.frames]))


def with_axes_exchanged(stack: FrameStack) -> FrameStack:
    """The set of a screen whose x and y are exchanged: x frames show what y frames should."""
    names = [pattern.name for pattern in stack.patterns]
    other = {"x": "y", "y": "x"}
    order = [
        names.index(other[name[0]] + name[1:]) if name[:2] in ("x_", "y_") else frame
        for frame, name in enumerate(names)
    ]
    return replace(stack, frames=stack.frames[order])


@pytest.mark.fast_cases(
    "3-the pictures are rotated by 180 degrees",
    "4-the pictures are mirrored left to right",
    "4-the pictures are mirrored top to bottom",
    "4-the pictures are rotated by 90 degrees counter-clockwise",
    "4-the pictures are rotated by 90 degrees clockwise",
    "4-the pictures are shown with columns and rows exchanged",
)
@pytest.mark.parametrize("what", TURNED)
@pytest.mark.parametrize("steps", [3, 4])
def test_turned_pictures_are_reported_and_rejected(what: str, steps: int) -> None:
    stack = turned(good_set(bench(steps)), TURNED[what])
    with pytest.raises(RejectedSetError) as rejected:
        check_set(stack, bench(steps))
    assert str(rejected.value).startswith(what)
    assert not rejected.value.flags  # no single frame is blamed


def test_a_screen_with_exchanged_axes_is_reported() -> None:
    with pytest.raises(RejectedSetError, match="pattern on the screen is shown with x and y"):
        check_set(with_axes_exchanged(good_set(bench())), bench())


def test_a_bowl_without_any_aberration_shows_the_orientation_too() -> None:
    bowl = good_set(bench(), film=FilmShape(37.1, 500.0))
    assert check_set(bowl, bench()).verdict == ("ok", "")
    with pytest.raises(RejectedSetError, match="rotated by 180 degrees"):
        check_set(turned(bowl, TURNED["the pictures are rotated by 180 degrees"]), bench())


@pytest.mark.parametrize("what", TURNED)
def test_a_full_cycle_names_turned_pictures(what: str) -> None:
    stack = turned(good_set(bench()), TURNED[what])
    nothing = np.full(len(stack.frames), np.nan)
    live = LiveReconstructor(bench(), bin_px=1)
    estimate = live.measure_full(list(stack.frames), 0.1 * np.arange(len(stack.frames)), nothing)
    assert estimate.verdict == "rejected"
    assert estimate.reason.startswith(what)


def test_wrinkles_are_no_orientation() -> None:
    """They leave more slope than is suspicious, and no turn explains them."""
    wrinkles = FilmShape(37.1, 500.0, wrinkles=(Wrinkle(60.0, lobes=12),))
    checked = check_set(good_set(bench(), film=wrinkles), bench())
    assert residual_urad(checked) > SUSPICIOUS_URAD


@pytest.mark.parametrize("distortion", [(), (0.05, -0.02, 0.0, 0.0)])
def test_pictures_without_a_phase_show_no_orientation(distortion: tuple[float, ...]) -> None:
    optics = bench(4)
    camera = optics.camera.model_copy(update={"distortion": distortion})
    lens = optics.model_copy(update={"camera": camera})
    unknown = np.full((2, 50), np.nan)
    assert find_orientation(lens, 0.0, np.zeros((2, 50)), unknown) is None


@pytest.mark.parametrize(("share", "is_named"), [(0.02, False), (1.0, True)])
def test_few_bins_at_the_edges_show_no_orientation(
    monkeypatch: pytest.MonkeyPatch, share: float, is_named: bool
) -> None:
    """Overexposed pictures, of which 2 % of the bins were left, were named rotated: the stated
    orientation could not be fitted to the few on the mirror, and another one could.
    """
    optics = bench(4)
    rows, columns = np.indices((optics.camera.height_px // 2, optics.camera.width_px // 2))
    places_px = 2.0 * np.stack([columns.ravel(), rows.ravel()])
    phase_rad = np.zeros(places_px.shape)
    phase_rad[:, int(share * places_px.shape[1]) :] = np.nan
    found = iter([(np.inf, 145)])
    monkeypatch.setattr(
        picture_orientation, "_residual_urad", lambda *given: next(found, (17.0, 436))
    )
    assert (find_orientation(optics, 37.0, places_px, phase_rad) is not None) == is_named
