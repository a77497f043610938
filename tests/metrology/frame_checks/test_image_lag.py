"""Light of the previous picture in each frame: found, taken out, and its rest in the error bar."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.geometry.spread_file import geometry_spread
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.figure.pixel_figure import measure_pixels, reconstruct_full
from membrane_ctrl.metrology.frame_checks.checked_set import Anchor, Checked
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.frame_stack import FrameStack, find_frames_before
from membrane_ctrl.metrology.phase.pattern_sequence import fringe_sequence
from membrane_ctrl.metrology.uncertainty.set_budget import assemble_budget
from membrane_ctrl.model.shape_estimate import judge_quality
from tests.worlds.light_bench import LightEffects, quarter_bench, render_frames, render_set

OPTICS = quarter_bench()
FloatArray = NDArray[np.float64]


def coefficients_um(stack: FrameStack, anchor: Anchor | None = None) -> tuple[Checked, FloatArray]:
    """The checked set, and Noll 2..36 of all its pixels."""
    checked = check_set(stack, OPTICS, anchor)
    full = reconstruct_full(OPTICS, checked, measure_pixels(OPTICS, checked))
    return checked, 1e3 * full.surface.coeffs_mm[1:]


@cache
def still_um(gamma: float = 1.0) -> tuple[Checked, FloatArray]:
    """Of a panel that holds nothing."""
    return coefficients_um(render_set(OPTICS, LightEffects(gamma=gamma), seed=2))


def held_row_um(checked: Checked) -> tuple[float, str, tuple[str, ...]]:
    """Height of the budget's row, the verdict and the doubts."""
    full = reconstruct_full(OPTICS, checked, measure_pixels(OPTICS, checked))
    budget = assemble_budget(OPTICS, checked, full, geometry_spread(OPTICS, None)[0], 0.4, None)
    row = next(row for row in budget.budget.rows() if row["name"] == "image_lag_share")
    verdict = judge_quality(full.quality)[0]
    return row["height_rms_um"], checked.verdict[0] if verdict == "ok" else verdict, budget.doubts


CASES = {
    "1 %": (LightEffects(image_lag_share=0.01), 0.03),
    "3 %": (LightEffects(image_lag_share=0.03), 0.05),
    "10 %": (LightEffects(image_lag_share=0.1), 0.3),
    "relaxing": (LightEffects(image_lag_share=0.05, first_order=True), 0.05),
    "rising faster": (LightEffects(image_lag_share=0.02, held_fall_share=0.04), 0.1),
    "rising faster, gamma": (
        LightEffects(image_lag_share=0.01, held_fall_share=0.03, gamma=1.8),
        0.1,
    ),
}


@pytest.mark.fast_cases("1 %", "10 %", "relaxing", "rising faster, gamma")
@pytest.mark.parametrize("name", CASES)
def test_held_light_is_found_and_removed(name: str) -> None:
    """The figure would be off by 3.6 µm at 1 %; no frame is flagged, and the rest is in the bar."""
    effects, allowed_um = CASES[name]
    checked, found_um = coefficients_um(render_set(OPTICS, effects, seed=3))
    off_um = float(np.linalg.norm(found_um - still_um(effects.gamma)[1]))
    fall = effects.image_lag_share if effects.held_fall_share is None else effects.held_fall_share
    assert checked.lag.rise == pytest.approx(effects.image_lag_share, rel=0.15)
    assert checked.lag.fall == pytest.approx(fall, rel=0.15)
    assert not checked.flags
    row_um, verdict, doubts = held_row_um(checked)
    assert off_um < allowed_um
    assert off_um < 2 * row_um + 0.03
    assert row_um < 2.0
    assert not doubts
    assert verdict == ("degraded" if checked.lag.share > 0.05 else "ok")
    if verdict == "degraded":
        assert "wait longer" in checked.verdict[1]


OTHER_EFFECTS = {
    "nothing": LightEffects(),
    "gamma": LightEffects(gamma=2.2),
    "blur": LightEffects(blur_px=2.0),
    "second reflection": LightEffects(ghost_share=0.02, ghost_shift_mm=(12.0, 5.0)),
    "uneven panel": LightEffects(fall_off=0.15),
    "camera response": LightEffects(response=lambda light: light ** (1 / 1.8)),
}


@pytest.mark.fast_cases("nothing", "gamma", "second reflection", "camera response")
@pytest.mark.parametrize("name", OTHER_EFFECTS)
def test_other_effects_are_not_taken_for_held_light(name: str) -> None:
    checked = check_set(render_set(OPTICS, OTHER_EFFECTS[name], seed=4), OPTICS)
    assert not checked.lag.corrected
    assert abs(checked.lag.share) < 3 * checked.lag.sigma
    assert checked.lag.sigma < 3e-3


def test_one_stale_frame_is_no_held_light() -> None:
    """It shows the previous picture whole; the others show nothing of it."""
    stack = render_set(OPTICS, LightEffects(), seed=5)
    stale = stack.sinusoids("y")[0]
    stack.frames[stale] = stack.frames[stale - 1]
    checked = check_set(stack, OPTICS)
    assert [flag.frame for flag in checked.flags] == [stale]
    assert not checked.lag.corrected


def test_times_state_the_order_of_the_frames() -> None:
    """Frames taken in another order than that of their patterns hold other pictures."""
    stack = render_set(OPTICS, LightEffects(), seed=6)
    count = len(stack.patterns)
    order = np.random.default_rng(1).permutation(count)
    shown = [stack.patterns[k] for k in order]
    frames = render_frames(OPTICS, LightEffects(image_lag_share=0.03), shown, seed=6)
    time_s = np.argsort(order).astype(float)
    mixed = replace(stack, frames=frames[np.argsort(order)], before=find_frames_before(time_s))
    checked, found_um = coefficients_um(mixed)
    assert checked.lag.share == pytest.approx(0.03, rel=0.1)
    assert np.linalg.norm(found_um - still_um()[1]) < 0.3


def test_frames_before_others_by_their_times() -> None:
    assert find_frames_before(np.array([2.0, 0.0, 1.0])) == (2, -1, 1)
    assert find_frames_before(np.array([0.0, math.nan])) is None
    assert find_frames_before(np.array([0.0, 0.0])) is None


def test_fringes_alone_show_it_where_y_follows_x() -> None:
    anchor = still_um()[0].make_anchor()
    shown = list(fringe_sequence(OPTICS.pattern))
    frames = render_frames(OPTICS, LightEffects(image_lag_share=0.03), shown, seed=7, before=None)
    stack = FrameStack(frames, tuple(shown), np.full(len(shown), math.nan), {})
    checked, found_um = coefficients_um(stack, anchor)
    assert checked.lag.share == pytest.approx(0.03, rel=0.1)
    assert np.linalg.norm(found_um - still_um()[1]) < 1.0


def live_um(
    effects: LightEffects, kind: str, reconstructor: LiveReconstructor, before: Pattern | None
) -> FloatArray:
    """Noll 2..36 of one live cycle."""
    shown = list(render_set(OPTICS, LightEffects()).patterns)
    if kind == "fringes":
        shown = list(fringe_sequence(OPTICS.pattern))
    frames = render_frames(OPTICS, effects, shown, seed=8, before=before)
    run = reconstructor.measure_full if kind == "full" else reconstructor.measure_fringes
    none = np.full(len(shown), math.nan)
    estimate = run(list(frames), 0.1 * np.arange(len(shown)), none)
    assert estimate.verdict == "ok", estimate.reason
    assert np.isfinite(reconstructor.common_covariance_um2).all()
    return estimate.coeffs_um[1:]


def test_live_cycles_take_it_out() -> None:
    """The full cycle finds it, the fringes-only cycles use it; the first picture is shown ahead."""
    spread = geometry_spread(OPTICS, None)[0]
    slow = LightEffects(image_lag_share=0.03)
    first = fringe_sequence(OPTICS.pattern)[0]
    found = {}
    for name, effects in (("still", LightEffects()), ("slow", slow)):
        reconstructor = LiveReconstructor(OPTICS, 2, spread=spread)
        for kind in ("full", "fringes"):
            found[name, kind] = live_um(effects, kind, reconstructor, first)
    for kind in ("full", "fringes"):
        assert np.linalg.norm(found["slow", kind] - found["still", kind]) < 0.2
