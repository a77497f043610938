"""What judges the loop on the estimate: the predicted PI, the comparison, correlated errors and
innovations.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np
import pytest

from membrane_ctrl.config.control import EstimatorConfig, LoopConfig, PumpConfig
from membrane_ctrl.control.error_correlation import ErrorCorrelation
from membrane_ctrl.control.inner_loop import InnerLoop, LoopInput
from membrane_ctrl.control.innovation_test import InnovationTest
from membrane_ctrl.control.loop_comparison import LoopComparison
from membrane_ctrl.control.predicted_pi import PredictedPi

DT_S = 0.02
DELAY_TICKS, LAG_S = 10, 0.3
LOOP = LoopConfig(feedforward_barometer=False, feedforward_temperature=False)
PUMP = PumpConfig(dead_fraction=0.0, start_fraction=0.0, stall_fraction=0.0)
ESTIMATOR = EstimatorConfig(pump_delay_s=DELAY_TICKS * DT_S, pump_lag_s=LAG_S)
NO_WEATHER = (math.nan, math.nan)
LEAK_UM_PER_S = 1.2


class Mirror:
    """An integrator behind a dead time and a lag, with weather and noise of a seed."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._walk_um = 0.1 * math.sqrt(DT_S) * rng.standard_normal(10_000)
        self._noise_um = rng.standard_normal(10_000)
        self._tube = deque([LEAK_UM_PER_S] * DELAY_TICKS)
        self._flow = LEAK_UM_PER_S
        self._um = 0.0
        self._tick = 0

    def read_um(self) -> float:
        return self._um + float(self._noise_um[self._tick])

    def advance(self, flow_um_per_s: float) -> None:
        self._tube.append(flow_um_per_s)
        self._flow -= (self._tube.popleft() - self._flow) * math.expm1(-DT_S / LAG_S)
        self._um += (self._flow - LEAK_UM_PER_S) * DT_S + float(self._walk_um[self._tick])
        self._tick += 1


def hold(
    loop: LoopConfig, seed: int, ticks: int, watch: Callable[[float, float], None]
) -> list[float]:
    """The readings of a mirror that a PI holds; `watch` gets each reading and the last flow."""
    mirror, controller = Mirror(seed), InnerLoop(loop, PUMP)
    controller.start(0.0, LEAK_UM_PER_S)
    flow, readings = LEAK_UM_PER_S, []
    for _ in range(ticks):
        reading_um = mirror.read_um()
        readings.append(reading_um)
        watch(reading_um, flow)
        given = LoopInput(0.0, 0.0, reading_um, math.nan, math.nan)
        flow = controller.step(given, DT_S).flow_um_per_s
        mirror.advance(flow)
    return readings


@pytest.mark.parametrize("gain", [0.3, 1.2])
def test_the_predicted_pi_reads_what_the_pi_would(gain: float) -> None:
    """Whatever loop holds the mirror meanwhile."""
    predicted: list[float] = []
    prediction = PredictedPi(LOOP, PUMP, ESTIMATOR)
    prediction.start(0.0, LEAK_UM_PER_S, LEAK_UM_PER_S)

    def predict(reading_um: float, flow: float) -> None:
        predicted.append(prediction.step(reading_um, 0.0, NO_WEATHER, flow, DT_S))

    other = LOOP.model_copy(update={"kp_per_s": gain})
    readings = hold(other, 3, 3000, predict)
    true = hold(LOOP, 3, 3000, lambda reading_um, flow: None)
    error_um = np.std(np.subtract(predicted, true)[500:])
    assert error_um < 0.1 * np.std(np.subtract(readings, true)[500:])


def test_the_predicted_pi_keeps_its_flow_in_a_tick_without_a_reading() -> None:
    prediction = PredictedPi(LOOP, PUMP, ESTIMATOR)
    prediction.start(0.0, LEAK_UM_PER_S, LEAK_UM_PER_S)
    prediction.step(1.0, 0.0, NO_WEATHER, LEAK_UM_PER_S, DT_S)
    flow = prediction.memory.flow_um_per_s
    assert math.isnan(prediction.step(math.nan, 0.0, NO_WEATHER, LEAK_UM_PER_S, DT_S))
    assert prediction.memory.flow_um_per_s == flow
    assert prediction.runs
    prediction.stop()
    assert not prediction.runs


def compare(own_um: float, other_um: float, noise_um: float, seed: int) -> LoopComparison:
    """Two minutes of two slow errors of these standard deviations behind the same noise."""
    rng = np.random.default_rng(seed)
    ticks, slow = 6000, math.exp(-DT_S)
    comparison = LoopComparison()
    own = other = 0.0
    for _ in range(ticks):
        kicks = math.sqrt(1 - slow**2) * rng.standard_normal(2)
        own, other = slow * own + own_um * kicks[0], slow * other + other_um * kicks[1]
        noise = noise_um * rng.standard_normal()
        comparison.step(own + noise, other + noise, DT_S)
    return comparison


def test_noise_is_no_error_of_the_loop() -> None:
    found = [compare(0.2, 0.2, 1.0, seed).errors for seed in range(10)]
    own_um2 = [errors.own.um2 for errors in found if errors is not None]
    assert len(own_um2) == 10
    assert np.mean(own_um2) == pytest.approx(0.04, abs=0.008)
    scores = [errors.excess.um2 / errors.excess.sigma_um2 for errors in found if errors]
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 2.2  # 1.2 over 40 seeds


def test_the_better_loop_is_found() -> None:
    for seed in range(4):
        worse, better = compare(0.4, 0.2, 1.0, seed).errors, compare(0.2, 0.4, 1.0, seed).errors
        assert worse is not None
        assert better is not None
        assert worse.excess.um2 > 2.0 * worse.excess.sigma_um2
        assert better.excess.um2 < -2.0 * better.excess.sigma_um2


def test_a_comparison_needs_time_and_forgets() -> None:
    comparison = LoopComparison()
    for _ in range(500):
        comparison.step(0.1, 0.2, DT_S)
    assert comparison.errors is None
    for _ in range(5000):
        comparison.step(math.nan, 0.2, DT_S)  # readings that are missing count for nothing
    assert comparison.errors is None
    comparison.reset()
    assert comparison.spans == 0


def correlate(error_um: Callable[[float, np.random.Generator], float], seed: int) -> float:
    correlation = ErrorCorrelation(LOOP, ESTIMATOR)
    rng = np.random.default_rng(seed)
    for tick in range(7500):
        correlation.step(error_um(tick * DT_S, rng), DT_S)
    return correlation.largest


def test_uncorrelated_errors_are_no_swing() -> None:
    def noise(time_s: float, rng: np.random.Generator) -> float:
        return float(rng.standard_normal())

    assert max(correlate(noise, seed) for seed in range(12)) < 0.33


def test_a_swing_is_found_behind_as_much_noise() -> None:
    def swing(time_s: float, rng: np.random.Generator) -> float:
        return math.sin(2 * math.pi * time_s / 3.7) + 0.7 * float(rng.standard_normal())

    assert min(correlate(swing, seed) for seed in range(12)) > 0.5


def test_correlation_is_unknown_at_first() -> None:
    correlation = ErrorCorrelation(LOOP, ESTIMATOR)
    for _ in range(500):
        correlation.step(1.0, DT_S)
    assert math.isnan(correlation.largest)


def test_innovations_that_are_correlated_or_large_are_described() -> None:
    rng = np.random.default_rng(5)
    white, large, slow = InnovationTest(), InnovationTest(), InnovationTest()
    assert "not known" in white.describe()
    value = 0.0
    for innovation in rng.standard_normal(6000).tolist():
        value = 0.9 * value + math.sqrt(1 - 0.81) * innovation
        white.step(innovation, DT_S)
        large.step(2.0 * innovation, DT_S)
        slow.step(value, DT_S)
    assert white.describe() == "its innovations are as predicted, and the cause is not known"
    assert "noisier laser" in large.describe()
    assert "correlated" in slow.describe()
