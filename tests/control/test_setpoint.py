"""Ramp and setpoint weight."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.control.setpoint_ramp import RAMP_SHARE, SetpointRamp
from membrane_ctrl.control.setpoint_weight import SetpointWeight


def ramped(
    target_um: float, mean_flow_um_per_s: float, ticks: int, dt_s: float = 0.02
) -> np.ndarray:
    ramp = SetpointRamp(3.0, 5.3)
    ramp.place(0.0)
    return np.array([ramp.advance(target_um, mean_flow_um_per_s, dt_s) for _ in range(ticks)])


@pytest.mark.parametrize("target_um", [25.0, -25.0, 0.01])
def test_ramp_arrives_without_overshoot(target_um: float) -> None:
    way_um = ramped(target_um, 1.24, 2000)
    assert way_um[-1] == pytest.approx(target_um, abs=1e-3)
    assert np.all(np.diff(way_um) * np.sign(target_um) >= 0)


def test_the_ramp_is_no_faster_than_its_setting() -> None:
    assert np.diff(ramped(25.0, 1.24, 100)) == pytest.approx(3.0 * 0.02)


def test_fall_is_no_faster_than_the_leak() -> None:
    assert np.diff(ramped(-25.0, 1.0, 100)) == pytest.approx(-RAMP_SHARE * 1.0 * 0.02)


def test_rise_leaves_the_pump_a_reserve() -> None:
    assert np.diff(ramped(25.0, 4.3, 100)) == pytest.approx(RAMP_SHARE * 1.0 * 0.02)


def test_slow_ticks_do_not_overshoot() -> None:
    assert ramped(1.0, 1.24, 5, dt_s=2.0).max() <= 1.0


def test_the_setpoint_weight_matches_the_textbook_formula() -> None:
    """PI on the filtered setpoint equals PI with weight b on the setpoint (K = 1, the measurement
    at 0).
    """
    weight, ti_s, dt_s = 0.4, 6.5, 0.002
    shaper, textbook_i, ours_i, worst = SetpointWeight(weight, ti_s), 0.0, 0.0, 0.0
    shaper.reset(0.0)
    for _ in range(10_000):
        shaped = shaper.update(1.0, dt_s)
        textbook_i += dt_s / ti_s
        ours_i += shaped * dt_s / ti_s
        worst = max(worst, abs(weight + textbook_i - (shaped + ours_i)))
    assert worst < 1e-3


def test_full_weight_is_transparent() -> None:
    shaper = SetpointWeight(1.0, 6.5)
    assert [shaper.update(x, 0.02) for x in (0.0, 1.0, -3.0)] == [0.0, 1.0, -3.0]


def test_zero_weight_is_the_slow_lag() -> None:
    shaper, lag = SetpointWeight(0.0, 6.5), LowPass()
    shaper.reset(0.0)
    lag.reset(0.0)
    assert [shaper.update(1.0, 0.02) for _ in range(5)] == pytest.approx(
        [lag.update(1.0, 0.02, 6.5) for _ in range(5)]
    )
