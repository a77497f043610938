"""Pictures clipped at any level, at either end, in measured sets and in live cycles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.figure.pixel_figure import measure_pixels, reconstruct_full
from membrane_ctrl.metrology.frame_checks.checked_set import RejectedSetError
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.clip_levels import find_clip_levels
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.model.shape_estimate import Verdict, judge_quality
from tests.worlds.light_bench import LightEffects, quarter_bench, render_set

Pictures = NDArray[np.uint8] | NDArray[np.uint16]


def measured(stack: FrameStack, bits: int = 8) -> tuple[Verdict, str, float]:
    """Verdict, reason and saturated share of a set."""
    optics = quarter_bench(bits=bits)
    try:
        checked = check_set(stack, optics)
    except RejectedSetError as error:
        return "rejected", str(error), error.saturated_fraction
    full = reconstruct_full(optics, checked, measure_pixels(optics, checked))
    return *judge_quality(full.quality), full.quality.saturated_fraction


def altered(
    change: Callable[[NDArray[np.float64]], NDArray[np.float64]], bits: int = 8
) -> FrameStack:
    """A good set whose counts went through a function, and were rounded."""
    stack = render_set(quarter_bench(bits=bits), LightEffects())
    counts = np.rint(change(stack.frames.astype(float)))
    return replace(stack, frames=counts.astype(stack.frames.dtype))


OVEREXPOSED = {
    "full scale": lambda counts: np.minimum(1.6 * counts, 255),
    "by far": lambda counts: np.minimum(3 * counts, 255),
    "video range": lambda counts: np.minimum(16 + 1.6 * counts * 219 / 255, 235),
    "full well": lambda counts: np.minimum(counts, 120),
}


@pytest.mark.parametrize("name", OVEREXPOSED)
def test_overexposed_sets_are_called_saturated(name: str) -> None:
    """Whatever the level: neither the focus nor the number of bins is blamed."""
    verdict, reason, share = measured(altered(OVEREXPOSED[name]))
    assert verdict == "rejected"
    assert reason.endswith("of the pixels are saturated: shorten the exposure")
    assert share > 0.9


def test_twelve_bits_on_the_left_of_sixteen() -> None:
    """The camera's full scale is 65520, not 65535."""
    stack = altered(lambda counts: np.minimum(1.6 * counts, 4095), bits=12)
    shifted = replace(stack, frames=(stack.frames << 4).astype(np.uint16))
    verdict, reason, share = measured(shifted, bits=16)
    assert verdict == "rejected"
    assert "saturated" in reason
    assert share > 0.9
    assert find_clip_levels(list(shifted.frames[:4]), 65535).white_adu == 65520


def test_clipping_of_the_brightest_part_counts_its_share() -> None:
    """The corners of the picture are darker."""
    verdict, reason, share = measured(render_set(quarter_bench(), LightEffects(clip_high=0.77)))
    assert verdict == "rejected"
    assert reason == f"{share:.1%} of the pixels are saturated: shorten the exposure"
    assert 0.5 < share < 0.8


def test_clipping_that_is_not_found_does_no_harm() -> None:
    """Of the highest 4 % of the counts, the darker corners spared: 0.02 µm of the figure."""
    optics = quarter_bench()
    found = []
    for level in (1.0, 0.775):
        checked = check_set(render_set(optics, LightEffects(clip_high=level)), optics)
        full = reconstruct_full(optics, checked, measure_pixels(optics, checked))
        found.append(1e3 * full.surface.coeffs_mm[1:])
    assert np.linalg.norm(found[1] - found[0]) < 0.02


@pytest.mark.parametrize("level", [0.08, 0.15])
def test_clipping_at_black_is_reported(level: float) -> None:
    """Also in the video range, where black is 16."""
    verdict, reason, share = measured(render_set(quarter_bench(), LightEffects(clip_low=level)))
    assert verdict == "rejected"
    assert "clipped at black: raise the camera's black level" in reason
    assert share < 0.01


SOUND = {
    "plain": LightEffects(),
    "gamma": LightEffects(gamma=2.2),
    "steep gamma": LightEffects(gamma=2.6, vignetting=0.0),
    "no vignetting": LightEffects(vignetting=0.0),
    "dark camera": LightEffects(dark_fraction=0.0, leak=0.001),
    "bright": LightEffects(white_fraction=0.98),
    "low noise": LightEffects(noise_share=0.3, vignetting=0.0),
}


@pytest.mark.fast_cases(
    "plain-8",
    "gamma-12",
    "steep gamma-8",
    "no vignetting-12",
    "dark camera-8",
    "bright-8",
    "low noise-12",
)
@pytest.mark.parametrize("bits", [8, 12])
@pytest.mark.parametrize("name", SOUND)
def test_sound_pictures_are_not_clipped(name: str, bits: int) -> None:
    stack = render_set(quarter_bench(bits=bits), SOUND[name])
    sinusoids = [stack.frames[k] for axis in "xy" for k in stack.sinusoids(axis)]
    found = find_clip_levels(sinusoids, 2**bits - 1)
    assert (found.white_adu, found.black_adu) == (2**bits - 1, -1)


def test_hot_and_dead_pixels_hide_no_clipping() -> None:
    """They lie beyond the level at which the others are clipped."""
    stack = altered(lambda counts: np.clip(counts, 16, 150))
    pixels = stack.frames.reshape(len(stack.frames), -1)
    pixels[:, ::40_009] = 255
    pixels[:, 7::40_009] = 0
    found = find_clip_levels([stack.frames[k] for k in stack.sinusoids("x")], 255)
    assert found.white_adu == 150
    assert measured(stack)[1].endswith("saturated: shorten the exposure")


def test_one_overexposed_frame_is_flagged_alone() -> None:
    """A single bad frame is no cause for another exposure."""
    stack = render_set(quarter_bench(), LightEffects())
    bad = stack.sinusoids("x")[2]
    stack.frames[bad] = np.minimum(2.0 * stack.frames[bad], 255).astype(np.uint8)
    checked = check_set(stack, quarter_bench())
    assert [flag.frame for flag in checked.flags] == [bad]


def test_live_cycle_names_saturation_below_full_scale() -> None:
    stack = altered(OVEREXPOSED["video range"])
    order = range(len(stack.frames))
    none = np.full(len(stack.frames), np.nan)
    reconstructor = LiveReconstructor(quarter_bench(), 2)
    estimate = reconstructor.measure_full(
        [stack.frames[k] for k in order], 0.1 * np.arange(18), none
    )
    assert estimate.verdict == "rejected"
    assert "saturated: shorten the exposure" in estimate.reason
