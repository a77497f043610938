"""Bands of a pulsed backlight in the phase steps of a set: found, removed, and not mistaken for
what looks the same.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.cli import run
from membrane_ctrl.metrology.frame_checks.band_removal import remove_bands
from membrane_ctrl.metrology.phase.clip_levels import ClipLevels
from membrane_ctrl.metrology.phase.frame_stack import FrameStack, bin_frames
from membrane_ctrl.metrology.phase.pixel_phases import pixel_phases
from membrane_ctrl.metrology.reconstruction.film_motion import combine_steps
from tests.studies.tracked_errors import CLEAN, SIZE
from tests.worlds.crossed_fringes import CrossedWorld

Array = NDArray[np.float64]
HEIGHT, WIDTH = 256, 240
ROW, COLUMN = np.mgrid[:HEIGHT, :WIDTH].astype(float)
INSIDE = np.hypot(ROW - 127.5, COLUMN - 119.5) < 115


def phases(turned: bool = False) -> Array:
    """Of x and y (2, height, width): 15 fringes each, bent and a little turned; x along the rows if
    `turned`.
    """
    across, along = 2 * np.pi * 15 * COLUMN / WIDTH, 2 * np.pi * 15 * ROW / HEIGHT
    bent = 2.0 * ((ROW - 127.5) / 128) ** 2 + 1.5 * (ROW - 127.5) * (COLUMN - 119.5) / 128**2
    x, y = across + 0.03 * along + bent, along - 0.03 * across - 0.7 * bent
    return np.stack([y, x] if turned else [x, y])


def stack_of(
    steps: int = 4,
    bands: float = 0.02,
    bands_across: float = 15.0,
    bend: float = 0.0,
    motion_rad: float = 0.0,
    turned: bool = False,
    noise_adu: float = 1.0,
    shared: float = 0.0,
    flicker: float = 0.0,
) -> FrameStack:
    """Steps of x, then of y, in 12 bits; bands, motion and noise of each frame, and `shared` bands
    of each axis.
    """
    random, frames, patterns = np.random.default_rng(7), [], []
    for axis, phase in zip(("x", "y"), phases(turned), strict=True):
        for k in range(steps):
            psi = (
                phase + 2 * np.pi * k / steps + motion_rad * random.normal() * (1 + COLUMN / WIDTH)
            )
            shown = 0.5 + 0.5 * np.cos(psi)
            shown += bend * np.sin(np.pi * shown) ** 2
            gain = 1 + bands * np.cos(2 * np.pi * (bands_across * ROW / HEIGHT + random.random()))
            gain *= 1 + flicker * random.normal()
            gain *= 1 + shared * np.sin(2 * np.pi * bands_across * ROW / HEIGHT + (axis == "y"))
            light = np.where(INSIDE, 200 + 3000 * (1 - 0.2 * COLUMN / WIDTH) * shown * gain, 20.0)
            frames.append(
                np.rint(light + random.normal(0, noise_adu, light.shape)).astype(np.uint16)
            )
            patterns.append(Pattern("sin", axis, k, shift_rad=2 * np.pi * k / steps))
    return FrameStack(np.stack(frames), tuple(patterns), np.full(2 * steps, np.nan), {})


def slow_error_rad(stack: FrameStack, gain: Array | None, turned: bool = False) -> float:
    """RMS error of both phases, as means over squares of 30 pixels: what would be shape."""
    seen = stack.frames.astype(float) if gain is None else stack.frames / gain[:, :, None]
    steps, out = len(seen) // 2, []
    for part, phase in zip((seen[:steps], seen[steps:]), phases(turned), strict=True):
        z = np.tensordot(np.exp(-2j * np.pi * np.arange(steps) / steps), part, 1)
        off = np.exp(1j * (np.angle(z) - phase)) * INSIDE
        out.append(off[:240].reshape(8, 30, 8, 30).sum(axis=(1, 3)))
    sums = np.array(out)[:, np.abs(out[0]) > 500]
    return float(np.sqrt(np.mean(np.angle(sums / sums.mean(axis=1, keepdims=True)) ** 2)))


@pytest.mark.parametrize(
    ("change", "turned", "share"),
    [
        ({}, False, 0.25),
        ({}, True, 0.25),
        ({"bands": 0.2}, False, 0.25),
        ({"bands_across": 15.4}, False, 0.25),
        ({"bands_across": 7.5, "bands": 0.1}, False, 0.25),
        ({"steps": 5}, False, 0.3),
        ({"steps": 8}, False, 0.3),
        ({"bands_across": 2.0}, False, 0.25),
        ({"bend": 0.05}, False, 0.25),
        ({"bend": 0.1, "bands": 0.004}, False, 0.4),
        ({"bend": 0.05, "motion_rad": 0.003}, False, 0.3),
    ],
)
def test_bands_are_removed_from_the_phases(
    change: dict[str, float], turned: bool, share: float
) -> None:
    stack = stack_of(turned=turned, **change)  # type: ignore[arg-type]
    found, binned, _ = remove_bands(stack, bin_frames(stack, 4095))
    assert found.gain is not None
    before, after = (slow_error_rad(stack, gain, turned) for gain in (None, found.gain))
    assert after < share * before
    pixels = (found.frames / found.gain[:, :, None])[:, INSIDE]
    assert binned.bin_px == 1
    np.testing.assert_allclose(binned.means[:, INSIDE], pixels, rtol=1e-5)


@pytest.mark.parametrize(
    "change",
    [
        {"bands": 0.0},
        {"bands": 0.0, "bend": 0.1},
        {"bands": 0.0, "bend": 0.1, "motion_rad": 0.3},
        {"bands": 0.0, "motion_rad": 0.3, "turned": True},
        {"bands": 0.0, "noise_adu": 60.0},
        {"bands": 0.0, "shared": 0.02},
        {"bands": 0.0, "flicker": 0.02},
        {"steps": 3},
    ],
)
def test_effects_that_look_like_bands_change_nothing(change: dict[str, float]) -> None:
    """Fringes of a bent panel and of a film that moved, noise, a lamp that flickers; three steps
    cannot tell.
    """
    stack = stack_of(**change)  # type: ignore[arg-type]
    binned = bin_frames(stack, 4095)
    found, same, _ = remove_bands(stack, binned)
    assert found.gain is None
    assert same is binned


@pytest.mark.parametrize(("bands_across", "flicker"), [(15.0, 0.0), (1.5, 0.01)])
def test_both_axes_have_the_same_light_afterwards(bands_across: float, flicker: float) -> None:
    """What all steps of an axis share bends no phase, but in the light of the other axis the film
    seems to move.
    """
    stack = stack_of(bands=0.01, shared=0.02, bands_across=bands_across, flicker=flicker)
    _, binned, _ = remove_bands(stack, bin_frames(stack, 4095))
    x, y = binned.means[:4].mean(axis=0), binned.means[4:].mean(axis=0)
    apart = [np.median((y / x)[row][INSIDE[row]]) for row in range(20, 236)]
    assert np.std(apart) < 2e-3


def test_bands_are_those_of_the_pixels_rows() -> None:
    """Bins of 4 x 4 pixels, whose middles are between two pixels."""
    stack = stack_of(bands=0.02)
    frames = stack.frames.repeat(4, axis=1).repeat(4, axis=2)
    row = (np.arange(4 * HEIGHT) + 0.5) / 4 - 0.5
    turns = 15 * (row - ROW[:, 0].repeat(4)) / HEIGHT
    assert np.abs(turns).max() < 0.03  # the bands of a large pixel are those of its rows
    fine = replace(stack, frames=frames)
    found, binned, _ = remove_bands(fine, bin_frames(fine, 4095))
    assert binned.bin_px == 4
    assert found.gain is not None
    coarse = remove_bands(stack, bin_frames(stack, 4095))[0].gain
    expected = np.array([np.interp(row, ROW[:, 0], one) for one in np.asarray(coarse)])
    np.testing.assert_allclose(found.gain[:, 8:-8], expected[:, 8:-8], atol=1e-3)


def test_a_frame_without_a_picture_does_not_change_the_bands() -> None:
    stack = stack_of(steps=5)
    stack.frames[1] = 0
    stack = replace(stack, unusable={1: "unreadable"})
    found, *_ = remove_bands(stack, bin_frames(stack, 4095))
    assert found.gain is not None
    np.testing.assert_array_equal(found.gain[1], 1)
    assert np.ptp(found.gain[[0, *range(2, 10)]], axis=1).min() > 0.01


def test_pixels_are_measured_without_the_bands() -> None:
    stack = stack_of(bands=0.02, noise_adu=0.0)
    gain = remove_bands(stack, bin_frames(stack, 4095))[0].gain
    assert gain is not None
    index, phase = np.flatnonzero(INSIDE), phases()[1]
    still = combine_steps(stack.weights([4, 5, 6, 7]), stack.shifts_rad([4, 5, 6, 7]), 1)
    fixed = (
        stack.design([4, 5, 6, 7]),
        still,
        index,
        np.zeros(index.size),
        phase[INSIDE],
        ClipLevels(4095),
    )
    seen, bare = (
        pixel_phases(stack.frames[4:], *fixed, gain[4:]),
        pixel_phases(stack.frames[4:], *fixed),
    )
    assert np.std(seen.phase_rad - phase[INSIDE]) < 0.5 * np.std(bare.phase_rad - phase[INSIDE])


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    "fault", ["the other axis", "black", "one picture twice", "exchanged", "all black"]
)
def test_wrong_pictures_are_no_bands(fault: str, turned: bool) -> None:
    stack = stack_of(bands=0.0, turned=turned)
    if fault == "the other axis":
        stack.frames[1] = stack.frames[5]
    elif fault == "black":
        stack.frames[1] = 20
    elif fault == "one picture twice":
        stack.frames[1] = stack.frames[0]
    elif fault == "exchanged":
        stack.frames[[1, 5]] = stack.frames[[5, 1]]
    else:
        stack.frames[:] = 20
    assert remove_bands(stack, bin_frames(stack, 4095))[0].gain is None


def test_the_gain_belongs_to_the_picture_that_it_was_found_in() -> None:
    stack = stack_of()
    found, *_ = remove_bands(stack, bin_frames(stack, 4095))
    order = [1, 0, *range(2, 8)]
    assert found.gain is not None
    moved = found.exchange_frames(order).gain
    assert moved is not None
    np.testing.assert_array_equal(moved, found.gain[order])


def measured(world: CrossedWorld, folder: Path) -> tuple[Array, str]:
    """Coefficients, and the reason of the verdict."""
    folder.mkdir()
    world.write_reference(folder / "full", frame_s=0.137)
    assert run(["measure", str(folder / "full"), "--no-pictures"]) == 0
    result = json.loads((folder / "full/result/result.json").read_text())
    return np.array(result["zernike"]["coeffs_um"]), result["quality"]["reason"]


@pytest.mark.parametrize(
    ("pulses_hz", "rolling_s", "most_um", "message"),
    [
        (1923.0, 16 / 1923.0, 0.05, ""),
        (130.0, 0.13, 0.25, "% of the light along the rows: expose for whole backlight pulses"),
    ],
)
def test_bands_bend_no_figure_of_a_full_set(
    tmp_path: Path, pulses_hz: float, rolling_s: float, most_um: float, message: str
) -> None:
    """Those of 1 % moved it by 0.1 µm, those of 16 % by micrometres or to a refusal."""
    steady = CrossedWorld(seed=1, **SIZE | CLEAN)  # type: ignore[arg-type]
    pulsed = CrossedWorld(seed=1, backlight_hz=pulses_hz, rolling_s=rolling_s, **SIZE | CLEAN)  # type: ignore[arg-type]
    (before_um, before), (after_um, after) = (
        measured(steady, tmp_path / "a"),
        measured(pulsed, tmp_path / "b"),
    )
    assert np.linalg.norm((after_um - before_um)[3:]) < most_um
    assert ("bands" in after) == bool(message)
    assert message in after
    assert "bands" not in before
