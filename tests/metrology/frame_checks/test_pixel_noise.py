"""Noise of pixels by what the phase steps leave, beside harmonics, flicker and old pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.metrology.frame_checks.pixel_noise import estimate_pixel_noise_adu
from membrane_ctrl.metrology.phase.frame_stack import FrameStack

Array = NDArray[np.float64]
ROWS, COLUMNS = 120, 160
STEPS = 4
USED = ([0, 1, 2, 3], [4, 5, 6, 7])
INDEX = np.arange(ROWS * COLUMNS)
NOISE_ADU = 20.0  # a thousandth of the light


def frames_of(respond: Callable[[Array, int], Array], steps: int = STEPS) -> FrameStack:
    """Frames of 16 bits: fringes of 20 pixels, through a response of frame and level."""
    rng = np.random.default_rng(1)
    row, column = np.mgrid[:ROWS, :COLUMNS].astype(float)
    shown, patterns = [], []
    for axis, phase_rad in (("x", 0.3 * column + 1e-3 * row**2), ("y", 0.28 * row)):
        for k in range(steps):
            shift_rad = 2 * np.pi * k / steps
            level = 0.5 + 0.4 * np.cos(phase_rad + shift_rad)
            light = 20_000 * respond(level, len(shown))
            shown.append(light + NOISE_ADU * rng.standard_normal(light.shape))
            patterns.append(Pattern("sin", axis, shift_rad=shift_rad))
    frames = np.rint(np.clip(shown, 0, 65_535)).astype(np.uint16)
    return FrameStack(frames, tuple(patterns), np.full(len(shown), np.nan), {})


def column_share(level: Array) -> Array:
    return np.asarray(np.linspace(-1, 1, level.shape[1]))


# The median of a chi-square of two freedoms is 0.69 of their number.
EXPECTED_ADU = NOISE_ADU * np.sqrt(np.log(4) / 2)


@pytest.mark.parametrize(
    "respond",
    [
        lambda level, k: level,
        lambda level, k: level**2.2,
        lambda level, k: level ** (1.6 + 0.3 * column_share(level)),
        lambda level, k: level * (1 + 0.01 * np.sin(3.0 * k)),
        lambda level, k: level + 0.02 * np.cos(2.0 * k),
    ],
    ids=["sound", "gamma", "gamma by angle", "flicker", "ambient light"],
)
def test_noise_is_that_of_the_pixels_alone(respond: Callable[[Array, int], Array]) -> None:
    """A gamma of 2.2 is no noise of 15 % of the light."""
    found = estimate_pixel_noise_adu(frames_of(respond), USED, INDEX)
    # Harmonics beyond the fourth leave 0.05 % of the light.
    assert 0.9 * EXPECTED_ADU < found < 1.25 * EXPECTED_ADU


def test_bands_of_known_gain_are_no_noise() -> None:
    gain = 1 + 0.1 * np.sin(0.2 * np.arange(ROWS) + np.arange(8)[:, None])
    banded = frames_of(lambda level, k: level * gain[k][:, None])
    found = estimate_pixel_noise_adu(replace(banded, gain=gain), USED, INDEX)
    assert found == pytest.approx(EXPECTED_ADU, rel=0.1)
    assert estimate_pixel_noise_adu(banded, USED, INDEX) > 20 * EXPECTED_ADU


def test_the_known_share_of_the_previous_picture_is_no_noise() -> None:
    sound = frames_of(lambda level, k: level)
    frames = sound.frames.astype(float)
    frames[1:] += 0.05 * (frames[:-1] - frames[1:])
    slow = replace(sound, frames=np.rint(frames).astype(np.uint16))
    # The picture before is known as it was seen: a share of a share is left.
    found = estimate_pixel_noise_adu(replace(slow, lag_shares=(0.05, 0.05)), USED, INDEX)
    assert found < 0.2 * estimate_pixel_noise_adu(slow, USED, INDEX)


def test_three_steps_show_no_noise() -> None:
    three = frames_of(lambda level, k: level, steps=3)
    assert np.isnan(estimate_pixel_noise_adu(three, ([0, 1, 2], [3, 4, 5]), INDEX))
