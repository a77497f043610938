"""Simulated frames of a multi-frequency set: each fault is named and repaired where possible; good
sets pass.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.metrology.frame_checks.frequency_series import (
    AxisSeries,
    SeriesCheck,
    check_series,
)
from membrane_ctrl.metrology.phase.phase_steps import equal_shifts

PERIODS = np.array([0.9, 3.9, 15.9])
SHIFTS = -equal_shifts(4)
PIXELS = 2000


def scene(second: float = 0.0, noise_adu: float = 1.0) -> tuple[AxisSeries, AxisSeries]:
    """y and then x, mean 110 and amplitude 90, with a second harmonic of the display."""
    rng = np.random.default_rng(7)
    axes = []
    for axis in "yx":
        place = rng.uniform(0.2, 0.8, PIXELS)
        phase = 2 * np.pi * PERIODS[:, None, None] * place + SHIFTS[:, None]
        frames = 110 + 90 * np.cos(phase) + 90 * second * np.cos(2 * phase)
        axes.append(
            AxisSeries(axis, frames + rng.normal(0, noise_adu, frames.shape), PERIODS, SHIFTS)
        )
    return axes[0], axes[1]


BLACK, WHITE = np.full(PIXELS, 15.0), np.full(PIXELS, 205.0)


def checked(axes: tuple[AxisSeries, ...]) -> SeriesCheck:
    return check_series(axes, BLACK, WHITE)


def spoiled(index: int, step: int, picture: np.ndarray) -> tuple[AxisSeries, AxisSeries]:
    """x with another picture in one place."""
    y, x = scene()
    frames = x.frames.copy()
    frames[index, step] = picture
    return y, replace(x, frames=frames)


def named(found: SeriesCheck) -> set[tuple[str, int, int]]:
    return {(flag.axis, flag.index, flag.step) for flag in found.flags}


@pytest.mark.parametrize("second", [0.0, 0.1])
def test_good_frames_pass_whatever_the_display_does(second: float) -> None:
    found = checked(scene(second))
    assert (found.verdict, found.flags) == ("ok", ())


@pytest.mark.parametrize("index", [0, 1, 2])
@pytest.mark.parametrize("step", [0, 1, 3])
def test_a_stale_frame_is_reported_and_left_out(index: int, step: int) -> None:
    y, x = scene()
    before = (
        y.frames[-1, -1]
        if (index, step) == (0, 0)
        else x.frames.reshape(-1, PIXELS)[4 * index + step - 1]
    )
    found = checked(spoiled(index, step, before + np.random.default_rng(1).normal(0, 1, PIXELS)))
    assert found.verdict == "degraded"
    assert named(found) == {("x", index, step)}
    assert found.flags[0].reason.startswith("stale: the same picture as ")
    # what three steps say, at their noise
    assert np.std(found.axes[1].frames[index, step] - x.frames[index, step]) < 3


@pytest.mark.parametrize("pair", [(0, 1), (1, 2), (0, 2), (1, 3)])
def test_exchanged_steps_are_reported_and_put_back(pair: tuple[int, int]) -> None:
    y, x = scene()
    frames = x.frames.copy()
    frames[1, list(pair)] = frames[1, list(pair[::-1])]
    found = checked((y, replace(x, frames=frames)))
    assert named(found) == {("x", 1, pair[0]), ("x", 1, pair[1])}
    assert np.array_equal(found.axes[1].frames, x.frames)


def test_a_flickering_frame_is_reported() -> None:
    _, x = scene()
    found = checked(spoiled(2, 1, 0.7 * x.frames[2, 1]))
    assert named(found) == {("x", 2, 1)}
    assert "does not agree" in found.flags[0].reason


def test_two_bad_frames_of_a_series_are_a_rejection() -> None:
    y, x = scene()
    frames = x.frames.copy()
    frames[2, 1], frames[2, 2] = frames[0, 0], 110.0
    found = checked((y, replace(x, frames=frames)))
    assert found.verdict == "rejected"
    assert "15.9 periods" in found.reason


def test_white_and_black_enclose_the_fringes() -> None:
    y, x = scene()
    assert named(check_series((y, x), WHITE, BLACK)) == {("white", 0, 0), ("black", 0, 0)}
    assert named(check_series((y, x), BLACK, x.frames[0, 0])) == {("white", 0, 0)}
