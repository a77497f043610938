"""The inner loop tick by tick: limits, bumpless changes, missing readings."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control.centre_estimate import CentreEstimate, Sensor, SensorView
from membrane_ctrl.control.inner_loop import InnerLoop, LoopInput, LoopOutput

DT_S = 0.02
LOOP = LoopConfig()
PUMP = PumpConfig()


def given_at(displacement_um: float, target_um: float = 0.0, trim_um: float = 0.0) -> LoopInput:
    return LoopInput(target_um, trim_um, displacement_um, math.nan, math.nan)


def settled(
    loop: LoopConfig = LOOP, displacement_um: float = 0.0, flow: float = 1.24
) -> tuple[InnerLoop, LoopOutput]:
    """A loop at its setpoint that needs this flow."""
    inner = InnerLoop(loop, PUMP)
    inner.start(displacement_um, flow)
    for _ in range(100):
        out = inner.step(given_at(displacement_um, displacement_um), DT_S)
    return inner, out


def test_start_is_at_the_reading_and_the_flow() -> None:
    inner = InnerLoop(LOOP, PUMP)
    inner.start(-25.0, 1.24)
    out = inner.step(given_at(-25.0, target_um=-25.0), DT_S)
    assert (out.setpoint_um, out.filtered_um, out.error_um) == (-25.0, -25.0, 0.0)
    assert out.i_um_per_s == out.flow_wanted_um_per_s == 1.24
    assert not out.saturated


def test_start_with_a_trim_is_at_the_reading_too() -> None:
    """After a restart of the loop the held trim is part of the mirror's position."""
    inner = InnerLoop(LOOP, PUMP)
    inner.start(7.0, 1.24)
    out = inner.step(given_at(7.0, target_um=0.0, trim_um=7.0), DT_S)
    assert out.setpoint_um == pytest.approx(7.0)
    assert out.flow_wanted_um_per_s == pytest.approx(1.24)


def test_trim_is_added_behind_the_ramp() -> None:
    inner, _ = settled()
    out = inner.step(given_at(0.0, 0.0, trim_um=0.002), DT_S)
    assert out.setpoint_um == pytest.approx(0.002)


def test_ramp_feeds_its_speed_forward() -> None:
    inner, _ = settled()
    before_um = inner.step(given_at(0.0), DT_S).setpoint_um
    out = inner.step(given_at(0.0, target_um=100.0), DT_S)
    assert out.feedforward_um_per_s == pytest.approx((out.setpoint_um - before_um) / DT_S)
    assert out.feedforward_um_per_s > 2.0


@pytest.mark.parametrize(
    ("displacement_um", "saturated"), [(50.0, True), (-50.0, True), (0.1, False), (-0.1, False)]
)
def test_saturation_is_reported(displacement_um: float, saturated: bool) -> None:
    inner, _ = settled()
    for _ in range(50):
        out = inner.step(given_at(displacement_um), DT_S)
    assert out.saturated == saturated


@pytest.mark.parametrize("missing", [math.nan, math.inf, -math.inf])
def test_missing_reading_gives_the_mean_flow(missing: float) -> None:
    inner, _ = settled()
    for _ in range(50):
        out = inner.step(given_at(missing), DT_S)
    assert out.flow_wanted_um_per_s == out.i_um_per_s == pytest.approx(1.24)
    assert (out.p_um_per_s, out.d_um_per_s, out.feedforward_um_per_s) == (0.0, 0.0, 0.0)


def test_returning_reading_continues_from_the_mean_flow() -> None:
    inner, _ = settled()
    for _ in range(500):
        inner.step_without_reading(given_at(math.nan), DT_S)
    out = inner.step(given_at(0.0), DT_S)
    assert out.flow_wanted_um_per_s == pytest.approx(1.24)


def test_manual_outputs_the_given_flow() -> None:
    inner, _ = settled()
    assert inner.follow_flow(given_at(0.0), 2.5, DT_S).flow_um_per_s == pytest.approx(2.5)
    assert inner.follow_flow(given_at(0.0), 99.0, DT_S).pump_fraction == pytest.approx(1.0)
    assert inner.follow_flow(given_at(0.0), -1.0, DT_S).pump_fraction == 0.0


def test_ramp_down_works_without_a_reading() -> None:
    inner = InnerLoop(LOOP, PUMP)
    out = inner.follow_flow(given_at(math.nan), 1.0, DT_S)
    assert out.flow_um_per_s == pytest.approx(1.0)
    assert math.isnan(out.filtered_um)


@given(st.floats(0.5, 5.0), st.floats(-500, 500), st.floats(-50, 50), st.floats(-0.3, 0.3))
def test_manual_to_automatic_is_bumpless(
    flow: float, displacement: float, trim: float, slope: float
) -> None:
    """In moving air too; the setpoint then starts where the mirror is."""
    inner, _ = settled(displacement_um=displacement)
    for k in range(100):
        reading = LoopInput(0.0, trim, displacement, 101_325.0 + slope * k * DT_S, 20.0)
        out = inner.follow_flow(reading, flow, DT_S)
    there = LoopInput(
        out.filtered_um - trim, trim, displacement, 101_325.0 + slope * 100 * DT_S, 20.0
    )
    assert inner.step(there, DT_S).flow_wanted_um_per_s == pytest.approx(flow, abs=1e-3)


def test_a_gust_at_the_end_of_an_experiment_does_not_shift_the_mean_flow() -> None:
    """Air that rises by 5 Pa/s for a moment; then it is still, and the mean flow holds."""
    inner, _ = settled()
    for k in range(100):
        risen = LoopInput(0.0, 0.0, 0.0, 101_325.0 + 5.0 * k * DT_S, 20.0)
        inner.follow_flow(risen, 1.2, DT_S)
    inner.resume_at_mean(risen, 1.2, DT_S)
    assert inner.mean_flow_um_per_s == pytest.approx(1.2)
    for _ in range(250):
        out = inner.step(risen, DT_S)
    assert out.flow_um_per_s == pytest.approx(1.2, abs=0.02)


def test_automatic_to_manual_at_the_present_flow_is_bumpless() -> None:
    inner, before = settled()
    after = inner.follow_flow(given_at(0.0), before.flow_um_per_s, DT_S)
    assert after.pump_fraction == pytest.approx(before.pump_fraction)


def test_gain_change_is_bumpless_off_the_setpoint() -> None:
    inner, _ = settled()
    for _ in range(20):
        before = inner.step(given_at(0.3, 0.0), DT_S)
    inner.set_gains(
        LOOP.model_copy(update={"kp_per_s": 1.2, "ti_s": 3.0, "td_s": 0.2, "setpoint_weight": 0.5})
    )
    after = inner.step(given_at(0.3, 0.0), DT_S)
    assert after.flow_wanted_um_per_s == pytest.approx(before.flow_wanted_um_per_s, abs=0.05)


def estimate_at(ahead_um: float, leak_um_per_s: float = 1.24) -> CentreEstimate:
    sensors = tuple(SensorView(True, 0.0, 0.25) for _ in Sensor)
    return CentreEstimate(
        um=ahead_um,
        sigma_um=0.05,
        mount_um=0.0,
        ahead_um=ahead_um,
        due_um_per_s=0.0,
        leak_um_per_s=leak_um_per_s,
        drift_um_per_s=leak_um_per_s,
        sensors=sensors,
    )


def step_on_estimate(inner: InnerLoop, estimate: CentreEstimate) -> LoopOutput:
    given = LoopInput(0.0, 0.0, 0.0, math.nan, math.nan, estimate)
    return inner.step(given, DT_S)


@pytest.mark.parametrize("ahead_um", [-0.05, 0.0, 0.04])
@pytest.mark.parametrize("leak_um_per_s", [1.0, 1.4])
def test_the_hand_over_to_the_estimate_is_bumpless(ahead_um: float, leak_um_per_s: float) -> None:
    """The error that the PI left is removed within two seconds, not in the first tick."""
    inner, before = settled()
    estimate = estimate_at(ahead_um, leak_um_per_s)
    flows = [step_on_estimate(inner, estimate).flow_wanted_um_per_s for _ in range(100)]
    assert flows[0] == pytest.approx(before.flow_um_per_s, abs=1e-9)
    assert max(abs(late - early) for early, late in itertools.pairwise(flows)) < 0.1
    settled_at = InnerLoop(LOOP, PUMP)
    settled_at.start(0.0, 1.24)
    assert flows[-1] == pytest.approx(
        step_on_estimate(settled_at, estimate).flow_wanted_um_per_s, abs=0.05
    )


def test_a_large_error_at_the_hand_over_is_removed_at_once() -> None:
    inner, _ = settled()
    flows = [step_on_estimate(inner, estimate_at(5.0)).flow_um_per_s for _ in range(6)]
    assert flows[-1] == 0.0


def test_no_second_hand_over_begins_while_the_estimate_is_followed() -> None:
    inner, _ = settled()
    for _ in range(200):
        step_on_estimate(inner, estimate_at(0.0))
    quick = step_on_estimate(inner, estimate_at(0.1)).flow_wanted_um_per_s
    assert quick < 0.0


def test_the_laser_takes_over_from_the_estimate_at_the_mean_flow() -> None:
    inner, _ = settled()
    for _ in range(50):
        step_on_estimate(inner, estimate_at(0.02, 1.1))
    out = inner.step(given_at(0.02), DT_S)
    assert out.flow_wanted_um_per_s == pytest.approx(1.1, abs=0.05)


def test_new_limits_apply_at_once() -> None:
    inner, _ = settled(flow=3.0)
    inner.set_gains(
        LOOP.model_copy(update={"flow_max_um_per_s": 2.0, "flow_rate_limit_um_per_s2": 1000.0})
    )
    out = inner.step(given_at(0.0), DT_S)
    assert out.flow_um_per_s <= 2.0 + 1e-12
    assert out.i_um_per_s <= 2.0


@pytest.mark.parametrize(
    "loop", [LOOP.model_copy(update={"setpoint_weight": b}) for b in (0.0, 0.5, 1.0)]
)
def test_a_large_constant_displacement_needs_no_integrator(loop: LoopConfig) -> None:
    """The zero of the laser is arbitrary: far from it nothing is different."""
    _, out = settled(loop, displacement_um=-1900.0)
    assert out.i_um_per_s == pytest.approx(1.24)
    assert out.flow_wanted_um_per_s == pytest.approx(1.24)


readings = st.one_of(st.floats(-3000, 3000), st.just(math.nan))
pressures = st.one_of(st.floats(80_000, 110_000), st.just(math.nan))
temperatures = st.one_of(st.floats(-20, 60), st.just(math.nan))
inputs = st.builds(
    LoopInput, st.floats(-2000, 500), st.floats(-100, 100), readings, pressures, temperatures
)
calls = st.tuples(
    st.sampled_from(["step", "step", "step", "stale", "follow", "start"]),
    inputs,
    st.floats(1e-3, 1.0),
)


@settings(max_examples=60)
@given(st.lists(calls, max_size=80))
def test_the_command_is_finite_and_in_range_for_any_input(
    run: list[tuple[str, LoopInput, float]],
) -> None:
    inner = InnerLoop(LoopConfig(td_s=0.3), PUMP)
    for call, reading, dt_s in run:
        if call == "start":
            inner.start(reading.displacement_um, reading.trim_um)
            continue
        if call == "step":
            out = inner.step(reading, dt_s)
        elif call == "stale":
            out = inner.step_without_reading(reading, dt_s)
        else:
            out = inner.follow_flow(reading, reading.trim_um, dt_s)
        assert out.pump_fraction == 0.0 or PUMP.stall_fraction < out.pump_fraction <= 1.0
        assert 0.0 <= out.flow_um_per_s <= PUMP.flow_full_um_per_s + 1e-9
        assert 0.0 <= out.i_um_per_s <= LOOP.flow_max_um_per_s
        assert math.isfinite(out.flow_wanted_um_per_s)


@settings(max_examples=40)
@given(st.lists(st.tuples(inputs, st.floats(1e-3, 0.1)), min_size=2, max_size=50))
def test_flow_changes_no_faster_than_its_rate_limit(run: list[tuple[LoopInput, float]]) -> None:
    inner, _ = settled(flow=2.0)
    for reading, dt_s in run:
        before = inner._limiter.flow_um_per_s
        inner.step(reading, dt_s)
        assert (
            abs(inner._limiter.flow_um_per_s - before)
            <= LOOP.flow_rate_limit_um_per_s2 * dt_s + 1e-9
        )
