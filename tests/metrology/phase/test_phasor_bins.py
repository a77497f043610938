"""Sums over bins, and phases followed from a reference."""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.metrology.numerics.compiled import compile_kernel
from membrane_ctrl.metrology.phase.bin_sums import FOLLOWED_ROWS, Binner
from membrane_ctrl.metrology.phase.phase_change import update_phases
from membrane_ctrl.metrology.phase.phase_steps import equal_shifts, step_weights
from membrane_ctrl.metrology.phase.phasor_kernels import branchless_arctan2
from membrane_ctrl.metrology.reconstruction.film_motion import combine_steps, is_worth_correcting

RNG = np.random.default_rng(7)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("bin_px", [1, 3, 4, 16])
def test_sums_are_those_of_the_pixels(bin_px: int, kind: type) -> None:
    top = int(np.iinfo(kind).max)
    frames = RNG.integers(0, top + 1, (2, 50, 71)).astype(kind)
    frames[0, : 2 * bin_px] = top  # the largest sum there can be
    binner = Binner(50, 71, bin_px, top, 2)
    binner.sum_frames(frames, [1, 0])
    rows, columns = 50 // bin_px, 71 // bin_px
    blocks = frames[:, : rows * bin_px, : columns * bin_px].reshape(
        2, rows, bin_px, columns, bin_px
    )
    assert np.array_equal(binner.sums[[1, 0]], blocks.sum(axis=(2, 4), dtype=np.int64))
    assert np.array_equal(binner.saturated, (blocks == top).sum(axis=(0, 2, 4)))


def test_only_watched_frames_count_as_saturated() -> None:
    binner = Binner(8, 8, 4, 255, 2)
    bright = np.full((8, 8), 255, np.uint8)
    binner.sum_frames([bright, bright], [0, 1], watched=[1])
    assert np.all(binner.saturated == 16)
    binner.clear_saturation()
    assert not binner.saturated.any()


def test_views_and_read_only_frames_are_accepted() -> None:
    frames = RNG.integers(0, 255, (8, 24)).astype(np.uint8)
    binner = Binner(8, 8, 4, 255, 1)
    view = frames[:, ::3]
    binner.sum_frames([view], [0])
    before = binner.sums.copy()
    copy = view.copy()
    copy.setflags(write=False)
    binner.sum_frames([copy], [0])
    assert np.array_equal(binner.sums, before)


@pytest.mark.parametrize(
    ("frame", "message"),
    [(np.zeros((8, 9), np.uint8), r"\(9, 8\) pixels"), (np.zeros((8, 8), np.float32), "float32")],
)
def test_wrong_frames_are_refused(frame: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Binner(8, 8, 4, 255, 1).sum_frames([frame], [0])


@compile_kernel
def _all_arctan2(y, x, out):  # type: ignore[no-untyped-def]
    for k in range(y.size):
        out[k] = branchless_arctan2(y[k], x[k])


def test_arctan2_is_the_librarys() -> None:
    angle = np.concatenate([np.linspace(-np.pi, np.pi, 9), RNG.uniform(-np.pi, np.pi, 2000)])
    length = 10 ** RNG.uniform(-6, 6, angle.size)
    x, y = length * np.cos(angle), length * np.sin(angle)
    out = np.empty_like(x)
    _all_arctan2(y, x, out)
    assert out == pytest.approx(np.arctan2(y, x), abs=2e-13)
    _all_arctan2(np.zeros(1), np.zeros(1), out[:1])
    assert out[0] == 0


def _followed(
    intensity: np.ndarray, last_rad: np.ndarray, sensitivity: np.ndarray, motion: np.ndarray | None
):  # type: ignore[no-untyped-def]
    """`track` on one axis, used twice, of frames given in thousandths."""
    steps, count = intensity.shape
    shifts = equal_shifts(steps)
    last = np.zeros((2, FOLLOWED_ROWS, count))
    last[:, 0], last[:, 1], last[:, 2] = last_rad, np.cos(last_rad), np.sin(last_rad)
    out = np.zeros_like(last)
    combined = combine_steps(step_weights(shifts), shifts, 1, motion)
    sums = np.rint(intensity * 1000).astype(np.uint32)
    update_phases(
        [sums] * 2, np.arange(count), [combined] * 2, np.stack([sensitivity] * 2), last, out
    )
    assert np.array_equal(out[0], out[1])
    return out[0]


@pytest.mark.parametrize("steps", [3, 4, 6])
def test_phase_is_followed_across_its_jumps(steps: int) -> None:
    before = RNG.uniform(-50, 50, 1000)
    change = RNG.uniform(-3.1, 3.1, 1000)
    intensity = 100 + 80 * np.cos(before + change + equal_shifts(steps)[:, None])
    phase, cosine, sine, seen, size = _followed(intensity, before, np.zeros(1000), None)
    assert seen == pytest.approx(change, abs=2e-5)
    assert phase == pytest.approx(before + change, abs=2e-5)
    assert np.hypot(cosine - np.cos(phase), sine - np.sin(phase)) == pytest.approx(0, abs=1e-9)
    assert size == pytest.approx(80e3, rel=1e-4)


def test_known_motion_is_removed_from_the_steps() -> None:
    """20 µm, 3 mrad of phase a micrometre: the error left is of third order."""
    phase = RNG.uniform(-3, 3, 500)
    q = RNG.uniform(-3e-3, 3e-3, 500)
    motion = 20 * np.sin(2 * np.pi * 0.3 * 0.1 * np.arange(4)) + 8.0
    intensity = 100 + 80 * np.cos(phase + q * motion[:, None] + equal_shifts(4)[:, None])
    raw = _followed(intensity, phase, q, None)[3]
    corrected = _followed(intensity, phase, q, motion)[3]
    assert np.abs(raw).max() > 0.04
    assert np.abs(corrected).max() < 1e-4


def test_a_constant_displacement_is_a_plain_shift() -> None:
    shifts = equal_shifts(5)
    combined = combine_steps(step_weights(shifts), shifts, 4, np.full(5, 3.0))
    assert combined.turn == pytest.approx([3.0, 9.0])
    assert np.abs(combined.mirror).max() < 1e-12


@pytest.mark.parametrize(
    ("readings", "worth"),
    [
        ([0.0, 9.0, 0.0, 9.0], True),
        ([0.0, 1.0, -1.0, 0.5], False),
        ([0.0, 9.0, math.nan, 9.0], False),
    ],
)
def test_motion_within_the_lasers_noise_is_not_corrected(
    readings: list[float], worth: bool
) -> None:
    assert is_worth_correcting(np.array(readings), 1.0) is worth
