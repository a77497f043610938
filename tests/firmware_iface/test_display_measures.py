"""Patterns, settle time, response, checkerboard and exposure: against displays whose truth is
known.
"""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from firmware_iface.checkerboard_check import explain_checkerboard
from firmware_iface.display_patterns import ScreenRaster, compute_pattern_light, make_checkerboard
from firmware_iface.display_response import (
    RAMP_LEVELS,
    make_linear_response,
    make_measured_response,
)
from firmware_iface.display_settling import fit_settling, share_left
from firmware_iface.exposure_check import explain_exposure
from firmware_iface.optical_roles import Pattern
from tests.worlds.panel import EmulatedPanel, PanelResponse

RASTER = ScreenRaster(341, 257, 0.25, periods=4, period_mm=14.0)


def test_sinusoids_have_the_stated_phase() -> None:
    column, row = 180, 100
    for axis, s_mm in (("x", (column - 170) * 0.25 + 28), ("y", (128 - row) * 0.25 + 28)):
        for k in range(4):
            light = compute_pattern_light(Pattern("sin", axis, k, k * math.pi / 2), RASTER)[
                row, column
            ]
            phi = 2 * math.pi * s_mm / 14.0 - math.pi
            assert light == pytest.approx(0.5 + 0.5 * math.cos(phi + k * math.pi / 2), abs=1e-6)


def test_crossed_fringes_share_the_light_of_both_axes() -> None:
    light = compute_pattern_light(Pattern("crossed", "", 7, 0.3, shift_y_rad=1.1), RASTER)
    phi_x = 2 * math.pi * ((180 - 170) * 0.25 + 28) / 8 - math.pi
    phi_y = 2 * math.pi * ((128 - 100) * 0.25 + 28) / 8 - math.pi
    assert light[100, 180] == pytest.approx(
        0.5 + 0.25 * (math.cos(phi_x + 0.3) + math.cos(phi_y + 1.1)), abs=1e-6
    )
    assert not light[compute_pattern_light(Pattern("white"), RASTER) == 0].any()


def test_gray_codes_number_the_half_periods() -> None:
    bits = [compute_pattern_light(Pattern("gray", "x", bit), RASTER)[128] for bit in range(1, 5)]
    code = sum(bit.astype(int) << (3 - k) for k, bit in enumerate(bits))
    value = code ^ (code >> 1) ^ (code >> 2) ^ (code >> 3)
    s_mm = RASTER.from_low_edge_mm("x")
    inside = (s_mm >= 0) & (s_mm < 56)
    assert np.array_equal(value[inside], np.floor(2 * s_mm[inside] / 14.0))
    assert not code[~inside].any()


def test_outside_of_the_region_it_is_dark() -> None:
    white, black = (compute_pattern_light(Pattern(role), RASTER) for role in ("white", "black"))
    assert white.sum() == pytest.approx((56 / 0.25) ** 2, rel=0.01)
    assert white[128, 170] == 1.0
    assert white[0, 0] == 0.0
    assert not black.any()
    with pytest.raises(ValueError, match="role must be"):
        compute_pattern_light(Pattern("gray", "x", 5), RASTER)


def test_a_region_larger_than_the_screen_is_refused() -> None:
    with pytest.raises(ValueError, match=r"needs 1594 pixels .* has 768; lower period_mm"):
        ScreenRaster(1366, 768, 0.25, periods=8, period_mm=49.82)


@given(latency_s=st.floats(0.0, 0.06), tau_s=st.floats(0.004, 0.03), seed=st.integers(0, 99))
@example(latency_s=0.0, tau_s=0.004, seed=40)  # falls between two frames
@settings(max_examples=40, deadline=None)
def test_settling_finds_what_was_put_in(latency_s: float, tau_s: float, seed: int) -> None:
    generator = np.random.default_rng(seed)
    delay_s = np.sort(generator.uniform(0.0, 0.45, 150))
    left = np.exp(-np.maximum(delay_s - latency_s, 0) / tau_s) + np.abs(
        generator.normal(0, 0.002, 150)
    )
    found = fit_settling(delay_s, left, noise=0.002)
    true_s = latency_s + tau_s * math.log(256)
    assert 0.85 * true_s < found.settle_s < 1.5 * true_s + 0.02


def test_a_slow_tail_is_part_of_the_settling_time() -> None:
    delay_s = np.linspace(0, 0.5, 100)
    left = 0.8 * np.exp(-delay_s / 0.01) + 0.2 * np.exp(-delay_s / 0.08)
    seen_s = float(delay_s[left > 1 / 32][-1])
    assert fit_settling(delay_s, left).settle_s > seen_s


def test_a_display_that_never_settles_is_reported() -> None:
    with pytest.raises(ValueError, match=r"50 % of a step is left after 0\.50 s"):
        fit_settling(np.linspace(0, 0.5, 50), np.full(50, 0.5))


def test_a_display_faster_than_the_first_frame() -> None:
    found = fit_settling([0.004, 0.02, 0.04], [0.001, 0.001, 0.0])
    assert found.settle_s == 0.004
    assert math.isnan(found.tau_s)


def test_share_left_is_of_the_step_and_blind_to_noise() -> None:
    generator = np.random.default_rng(3)
    before, after = np.full((256, 256), 20.0), np.full((256, 256), 200.0)
    frame = 0.25 * before + 0.75 * after + generator.normal(0, 2, before.shape)
    assert share_left(frame, before, after) == pytest.approx(0.25, abs=0.01)
    assert share_left(after + generator.normal(0, 2, before.shape), before, after) < 0.01


def test_panel_is_first_order_from_its_refresh_on() -> None:
    time_s = 0.0
    panel: EmulatedPanel[str] = EmulatedPanel(PanelResponse(60.0, 0.01, 0.012), lambda: time_s)
    panel.send("black")
    time_s = 1.003
    panel.send("white")
    lights_s = math.ceil(1.003 * 60) / 60 + 0.01
    time_s = lights_s - 0.002
    assert panel.lit(0.001) == [(0.0, "white"), (1.0, "black")]
    time_s = lights_s + 0.012
    (white, _), (black, _) = panel.lit(1e-6)
    assert white == pytest.approx(1 - math.exp(-1), abs=1e-4)
    assert white + black == pytest.approx(1.0)


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.2, 2.8])
def test_response_makes_light_linear(gamma: float) -> None:
    levels = np.array(RAMP_LEVELS)
    seen = 6.0 + 190.0 * (levels / 255) ** gamma
    response = make_measured_response(levels, seen)
    assert response.gamma == pytest.approx(gamma, rel=0.02)
    wanted = np.linspace(0.05, 1.0, 200)
    light = (response.find_levels(wanted) / 255.0) ** gamma
    half_a_step = 0.5 * gamma / 255  # at the bright end, where the curve is steepest
    assert np.abs(light - wanted).max() < half_a_step + 0.002


def test_a_linear_response_changes_nothing() -> None:
    assert np.array_equal(
        make_linear_response().find_levels(np.arange(256) / 255.0), np.arange(256)
    )


@pytest.mark.parametrize(
    ("seen", "words"),
    [
        (np.full(17, 50.0), "sees no ramp"),
        (np.r_[np.linspace(0, 200, 9), np.linspace(150, 200, 8)], "dynamic contrast"),
        (np.minimum(np.linspace(0, 400, 17), 255), "saturates"),
        (np.full(17, np.nan), "sees no ramp"),
    ],
)
def test_a_ramp_that_is_none(seen: np.ndarray, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make_measured_response(RAMP_LEVELS, seen)


def seen_through(levels: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """What an unresolving camera sees of levels that a scaler stretched and a panel of gamma 2.2
    lit.
    """
    if scale != 1.0:
        length = levels.shape[1]
        at = np.clip(np.arange(length) / scale, 0, length - 1)
        low = np.floor(at).astype(int)
        high, share = np.minimum(low + 1, length - 1), at - low
        levels = levels[:, low] * (1 - share) + levels[:, high] * share
    light = (np.asarray(levels, np.float64) / 255.0) ** 2.2
    return 5 + 200 * light.reshape(64, 4, 320, 4).mean(axis=(1, 3))


def test_checkerboard_shown_as_sent_and_scaled() -> None:
    white, black = seen_through(np.full((256, 1280), 255)), seen_through(np.zeros((256, 1280)))
    board = make_checkerboard(1280, 256)
    assert explain_checkerboard(seen_through(board), white, black) == ""
    assert "bands" in explain_checkerboard(seen_through(board, 1366 / 1360), white, black)
    half = np.full((256, 1280), 127.5)  # mixed everywhere
    assert "22 % of white instead of 50" in explain_checkerboard(seen_through(half), white, black)
    assert "does not see the screen" in explain_checkerboard(black, black, black)


@pytest.mark.parametrize(
    ("white", "black", "words"),
    [
        (200, 5, ""),
        (255, 5, "saturated.*lower exposure_ms = 20"),
        (30, 2, "raise exposure_ms = 20 to about 140"),
        (180, 90, "other light"),
    ],
)
def test_exposure(white: int, black: int, words: str) -> None:
    frames = (np.full((64, 64), level, np.uint8) for level in (white, black))
    problem = explain_exposure(*frames, 255, 20.0)
    assert bool(problem) == bool(words)
    if words:
        assert re.search(words, problem), problem
