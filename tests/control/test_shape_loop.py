"""The shape loop: which shapes it uses, how it moves the trim, and why it is suspended."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.config.schema import ShapeConfig
from membrane_ctrl.control.shape_code import ShapeCode
from membrane_ctrl.control.shape_loop import ShapeLoop, ShapeOutput
from membrane_ctrl.control.shape_reference import SHAPES, TRACKED_EVERY_S, TRACKED_SHAPES
from membrane_ctrl.model.reason import NO_REASON, Reason
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import ShapeState
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from tests.studies.shape_loop import SENSITIVITY, estimate_of

CONFIG = ShapeConfig(time_constant_s=60.0)
PERIOD_S, DT_S = 2.0, 0.1
QUIET = np.zeros(ZERNIKE_TERMS)


class Bench:
    """A shape loop with a mirror of known sag and laser drift, a shape every 2 s."""

    def __init__(self, config: ShapeConfig = CONFIG) -> None:
        self.loop = ShapeLoop(config, SENSITIVITY)
        self.now_s = 0.0
        self.sag_um = 0.0
        self.bias_um = 0.0
        self.trims_um: list[float] = []
        self.loop.switch(True, 0.0)

    def run(
        self, seconds: float, settled: bool = True, shapes: bool = True, **change: Any
    ) -> ShapeOutput:
        """Let time pass; `change` alters the estimates."""
        for _ in range(round(seconds / DT_S)):
            self.now_s += DT_S
            laser_um = self.sag_um + self.bias_um
            due = shapes and round(self.now_s / DT_S) % round(PERIOD_S / DT_S) == 0
            estimate = self.estimate(**change) if due else None
            out = self.loop.step(self.now_s, DT_S, estimate, laser_um, settled)
            self.trims_um.append(out.trim_um)
        return out

    def estimate(self, **change: Any) -> ShapeEstimate:
        made = estimate_of(self.now_s - 0.5, self.sag_um, self.sag_um + self.bias_um, QUIET)
        return dataclasses.replace(made, **change)


@pytest.fixture
def tracking() -> Bench:
    bench = Bench()
    assert bench.run(30.0).state == ShapeState.TRACKING
    return bench


def test_reference_is_taken_first() -> None:
    bench = Bench()
    assert bench.run(1.0).reason.code == ShapeCode.WAITING
    out = bench.run(SHAPES * PERIOD_S - 2.0)
    assert (out.state, out.reason.text) == (
        ShapeState.WAITING,
        f"reference: shape {SHAPES - 1} of {SHAPES}",
    )
    out = bench.run(PERIOD_S)
    assert (out.state, out.reason, out.trim_um) == (ShapeState.TRACKING, NO_REASON, 0.0)
    assert math.isnan(out.sag_change_um)


def test_single_frames_make_a_reference_of_as_many_readings() -> None:
    """Twenty figures a second share the laser's readings: five of them would be a quarter of a
    second.
    """
    bench = Bench()
    for k in range(12 * 20):
        bench.now_s = k / 20
        out = bench.loop.step(
            bench.now_s, 0.05, bench.estimate(kind="track", time_s=bench.now_s), 0.0, True
        )
        if out.state == ShapeState.TRACKING:
            break
    assert bench.now_s == pytest.approx((TRACKED_SHAPES - 1) * TRACKED_EVERY_S, abs=1.3)
    assert bench.loop.step(12.0, 0.05, None, 0.0, True).reason == NO_REASON


def test_no_reference_is_taken_before_the_loop_has_settled() -> None:
    out = Bench().run(60.0, settled=False)
    assert (out.state, out.reason.code) == (ShapeState.WAITING, ShapeCode.NOT_SETTLED)


def test_the_trim_converges_to_the_laser_drift(tracking: Bench) -> None:
    """The laser reads 3 µm too much, the camera sees no change:
    the setpoint must be 3 µm higher.
    """
    tracking.bias_um = 3.0
    out = tracking.run(600.0)
    assert out.trim_um == pytest.approx(3.0, abs=0.01)
    assert out.sag_change_um == pytest.approx(0.0, abs=1e-9)
    assert out.age_s == pytest.approx(0.5)


def test_a_changed_setpoint_is_not_mistaken_for_drift(tracking: Bench) -> None:
    tracking.sag_um = 5.0
    out = tracking.run(300.0)
    assert out.trim_um == pytest.approx(0.0, abs=1e-9)
    assert out.sag_change_um == pytest.approx(5.0)


def test_trim_is_bounded_in_rate(tracking: Bench) -> None:
    tracking.bias_um = 9.0
    tracking.run(120.0)
    assert np.abs(np.diff(tracking.trims_um)).max() <= CONFIG.trim_rate_max_um_per_s * DT_S + 1e-12


def test_the_trim_is_limited_in_range_and_reports_it() -> None:
    bench = Bench(CONFIG.model_copy(update={"trim_max_um": 2.0}))
    bench.run(30.0)
    bench.bias_um = 5.0
    out = bench.run(300.0)
    assert (out.trim_um, out.state) == (2.0, ShapeState.TRACKING)
    assert out.reason.code == ShapeCode.TRIM_LIMIT
    bench.bias_um = 0.0
    assert bench.run(600.0).trim_um == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"verdict": "rejected", "reason": "tracking lost"}, "tracking lost"),
        ({"displacement_um": math.nan}, "no laser reading"),
        ({"coeffs_um": np.full(ZERNIKE_TERMS, math.nan)}, "not finite"),
        ({"covariance_um2": np.full((ZERNIKE_TERMS, ZERNIKE_TERMS), math.inf)}, "not finite"),
        ({"time_s": 1.0}, "younger"),
        ({"displacement_um": 40.0}, "moved"),
        ({"coeffs_um": SENSITIVITY * 11.0}, "disagree"),
        ({"coeffs_um": SENSITIVITY * -11.0}, "disagree"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_suspended_with_a_reason_and_the_trim_held(
    tracking: Bench, change: dict[str, Any], word: str
) -> None:
    tracking.bias_um = 2.0
    held_um = tracking.run(600.0).trim_um
    out = tracking.run(2 * PERIOD_S + 0.1, **change)
    assert out.state == ShapeState.SUSPENDED
    assert word in out.reason.text
    out = tracking.run(60.0, **change)
    assert (out.state, out.trim_um) == (ShapeState.SUSPENDED, pytest.approx(held_um, abs=0.1))
    assert len(set(tracking.trims_um[-500:])) == 1
    assert tracking.run(2 * PERIOD_S).state == ShapeState.TRACKING


def test_laser_and_optics_agree_up_to_the_limit(tracking: Bench) -> None:
    limit_um = CONFIG.disagreement_max_um
    assert (
        tracking.run(PERIOD_S, coeffs_um=SENSITIVITY * (limit_um - 0.01)).state
        == ShapeState.TRACKING
    )
    tracking.loop.lock(tracking.now_s)
    tracking.run(30.0)
    assert (
        tracking.run(PERIOD_S, coeffs_um=SENSITIVITY * (limit_um + 0.01)).state
        == ShapeState.SUSPENDED
    )


def test_degraded_shape_is_used(tracking: Bench) -> None:
    assert tracking.run(30.0, verdict="degraded").state == ShapeState.TRACKING


def test_missing_shapes_suspend_the_loop(tracking: Bench) -> None:
    assert tracking.run(CONFIG.fresh_s - 1.0, shapes=False).state == ShapeState.TRACKING
    out = tracking.run(5.0, shapes=False)
    assert (out.state, out.reason) == (
        ShapeState.SUSPENDED,
        Reason(ShapeCode.NO_SHAPE, "no shape younger than 15 s"),
    )
    assert out.age_s > CONFIG.fresh_s


def test_shape_from_before_settling_is_not_used(tracking: Bench) -> None:
    tracking.run(0.1, settled=False)
    out = tracking.loop.step(tracking.now_s + DT_S, DT_S, tracking.estimate(), 0.0, True)
    assert out.state == ShapeState.SUSPENDED
    assert out.reason.code == ShapeCode.MOVED_MEANWHILE


def test_repeated_shape_is_not_used_twice(tracking: Bench) -> None:
    estimate = tracking.estimate()
    tracking.loop.step(tracking.now_s + 0.1, DT_S, estimate, 0.0, True)
    out = tracking.loop.step(tracking.now_s + 0.2, DT_S, estimate, 0.0, True)
    assert (out.state, out.reason.code) == (ShapeState.SUSPENDED, ShapeCode.NOT_NEWER)


def test_switching_off_keeps_the_trim_and_switching_on_continues_from_it(tracking: Bench) -> None:
    tracking.bias_um = 2.0
    held_um = tracking.run(600.0).trim_um
    tracking.loop.switch(False, tracking.now_s)
    tracking.bias_um = 7.0
    out = tracking.run(60.0)
    assert (out.state, out.reason.code, out.trim_um) == (
        ShapeState.OFF,
        ShapeCode.SWITCHED_OFF,
        held_um,
    )
    tracking.loop.switch(True, tracking.now_s)
    out = tracking.run(60.0)
    assert (out.state, out.trim_um) == (ShapeState.TRACKING, pytest.approx(held_um))
    tracking.bias_um = 8.0
    assert tracking.run(600.0).trim_um == pytest.approx(held_um + 1.0, abs=0.01)


def test_switching_on_twice_keeps_the_reference(tracking: Bench) -> None:
    tracking.loop.switch(True, tracking.now_s)
    assert tracking.run(DT_S).state == ShapeState.TRACKING
