"""Closure of phase steps: which frame is wrong."""

import numpy as np
import pytest

from membrane_ctrl.metrology.frame_checks.closure import (
    closure_with_level,
    closure_with_phase,
    compute_closure,
)
from membrane_ctrl.metrology.phase.phase_steps import equal_shifts

PIXELS = 4000
NOISE_ADU = 0.5


def scene(steps, seed=1):
    """Frames with their shifts and what is true of the pixels."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(-20, 20, PIXELS)
    mean, amplitude = rng.uniform(90, 130, PIXELS), rng.uniform(60, 100, PIXELS)
    shifts = equal_shifts(steps)
    frames = (
        mean
        + amplitude * np.cos(phase + shifts[:, None])
        + rng.normal(0, NOISE_ADU, (steps, PIXELS))
    )
    return frames, shifts, phase, mean, amplitude


def checks(frames, shifts, phase, mean, amplitude):
    """The closures that can name a frame for this number of steps."""
    out = [
        closure_with_phase(frames, shifts, phase),
        closure_with_level(frames, shifts, mean, amplitude),
    ]
    return out if len(shifts) == 4 else [compute_closure(frames, shifts), *out]


@pytest.mark.parametrize("steps", [4, 5, 8])
def test_good_frames_leave_noise_and_no_frame_is_suspect(steps):
    for result in checks(*scene(steps)):
        assert result.rms_adu == pytest.approx(NOISE_ADU, rel=0.03)
        np.testing.assert_allclose(result.without_rms_adu, NOISE_ADU, rtol=0.05)
        assert result.residual_ratio == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("steps", [4, 5, 8])
@pytest.mark.parametrize("bad", [0, 2, 3])
def test_a_stale_frame_is_the_suspect(steps, bad):
    frames, *truth = scene(steps)
    frames[bad] = frames[bad - 1]
    for result in checks(frames, *truth):
        assert result.suspect_frame == bad
        assert result.residual_ratio > 10
        assert result.without_rms_adu[bad] == pytest.approx(NOISE_ADU, rel=0.05)


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_a_partly_stale_frame_is_the_suspect(share):
    frames, *truth = scene(4)
    frames[2] += share * (frames[1] - frames[2])
    for result in checks(frames, *truth):
        assert result.suspect_frame == 2
        assert result.residual_ratio > 1.2


def test_four_steps_alone_show_the_fault_but_no_suspect():
    frames, shifts, *_ = scene(4)
    frames[1] += 30
    result = compute_closure(frames, shifts)
    assert result.rms_adu == pytest.approx(
        15, rel=0.01
    )  # (I0 - I1 + I2 - I3) / 2 for one degree of freedom
    np.testing.assert_allclose(result.frame_rms_adu, 7.5, rtol=0.01)
    assert result.suspect_frame is None
    assert result.residual_ratio == 1


@pytest.mark.parametrize("shifts", [equal_shifts(6), np.array([0.0, 1.1, 2.9, 3.3, 5.2, 5.9])])
def test_leaving_out_equals_fitting_again_without(shifts):
    frames = np.random.default_rng(3).normal(100, 20, (6, 50))
    result = compute_closure(frames, shifts)
    for k in range(6):
        rest = np.arange(6) != k
        design = np.stack([np.ones(5), np.cos(shifts[rest]), np.sin(shifts[rest])], axis=1)
        rss = np.linalg.lstsq(design, frames[rest], rcond=None)[1]
        assert result.without_rms_adu[k] == pytest.approx(np.sqrt(rss.mean() / 2))


@pytest.mark.parametrize("bad", [0, 1, 2, 3])
def test_leaving_out_with_known_phase_equals_fitting_again_without(bad):
    _, shifts, phase, *_ = scene(4)
    phase = phase[:20]
    frames = np.random.default_rng(4).normal(100, 20, (4, 20))
    rest = np.arange(4) != bad
    rss = []
    for pixel in range(20):
        design = np.stack([np.ones(3), np.cos(phase[pixel] + shifts[rest])], axis=1)
        rss.append(np.linalg.lstsq(design, frames[rest, pixel], rcond=None)[1][0])
    without = closure_with_phase(frames, shifts, phase).without_rms_adu[bad]
    assert without == pytest.approx(np.sqrt(np.mean(rss)))


@pytest.mark.parametrize("bad", [0, 1, 2, 3])
def test_leaving_out_with_known_level_equals_fitting_again_without(bad):
    _, shifts, _, mean, amplitude = scene(4)
    frames = np.random.default_rng(5).normal(100, 20, (4, PIXELS))
    rest = np.arange(4) != bad
    design = np.stack([np.cos(shifts[rest]), -np.sin(shifts[rest])], axis=1)
    phasor, rss, *_ = np.linalg.lstsq(design, frames[rest] - mean, rcond=None)
    length = np.hypot(*phasor)
    variance = np.sum(phasor * np.linalg.solve(design.T @ design, phasor), axis=0) / length**2
    rss = rss + (length - amplitude) ** 2 / variance
    without = closure_with_level(frames, shifts, mean, amplitude).without_rms_adu[bad]
    assert without == pytest.approx(np.sqrt(rss.mean() / 2))


def test_images_and_lists_of_pixels_give_the_same():
    frames, shifts, phase, mean, amplitude = scene(4)
    image = frames.reshape(4, 50, 80)
    flat = closure_with_level(frames, shifts, mean, amplitude)
    assert (
        closure_with_level(image, shifts, mean.reshape(50, 80), amplitude.reshape(50, 80)).rms_adu
        == flat.rms_adu
    )
    assert (
        closure_with_phase(image, shifts, phase.reshape(50, 80)).residual_ratio
        == closure_with_phase(frames, shifts, phase).residual_ratio
    )


def test_three_steps_always_agree_and_are_refused():
    with pytest.raises(ValueError, match="four or more"):
        compute_closure(np.zeros((3, 10)), equal_shifts(3))


def test_no_pixels_are_refused():
    with pytest.raises(ValueError, match="no pixels"):
        compute_closure(np.zeros((4, 0)), equal_shifts(4))


def test_steps_without_a_phase_are_refused():
    with pytest.raises(ValueError, match="do not determine"):
        compute_closure(np.zeros((4, 10)), [0.0, np.pi, 0.0, np.pi])


def test_a_pixel_without_any_fringe_weighs_no_more_than_others():
    frames, shifts, _, mean, amplitude = scene(4)
    frames[:, 0] = mean[0]
    result = closure_with_level(frames, shifts, mean, amplitude)
    assert result.rms_adu == pytest.approx(
        np.sqrt(NOISE_ADU**2 + 2 * amplitude[0] ** 2 / 3 / PIXELS), rel=0.05
    )
