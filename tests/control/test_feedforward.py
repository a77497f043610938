"""Feed-forward: sign, size, and intermittent sensors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.control.feedforward import FeedForward
from membrane_ctrl.control.weather_limits import explain_weather_fault

DT_S = 0.02


def answered(loop: LoopConfig, pressure_pa: np.ndarray, air_c: np.ndarray) -> np.ndarray:
    feedforward = FeedForward(loop)
    return np.array(
        [feedforward.update(p, t, DT_S) for p, t in zip(pressure_pa, air_c, strict=True)]
    )


def test_pressure_step_is_compensated() -> None:
    """+20 Pa flatten the bowl by 7.16 µm; the feed-forward adds as much."""
    pressure_pa = np.where(np.arange(1000) < 10, 101_325.0, 101_345.0)
    flow = answered(LoopConfig(), pressure_pa, np.full(1000, 20.0))
    assert flow.sum() * DT_S == pytest.approx(20 * 0.358)


def test_temperature_step_is_compensated_at_the_speed_of_the_gas() -> None:
    """+0.1 K swells the gas by 12.3 µm, 63 % of it within the gas's lag."""
    air_c = np.where(np.arange(10_000) < 1, 20.0, 20.1)
    given = np.cumsum(answered(LoopConfig(), np.full(10_000, math.nan), air_c)) * DT_S
    assert given[-1] == pytest.approx(-12.3, rel=1e-3)
    assert given[600] == pytest.approx(-12.3 * (1 - math.exp(-1)), rel=0.01)


def test_without_sensors_there_is_no_feedforward() -> None:
    nothing = np.full(10, math.nan)
    assert not answered(LoopConfig(), nothing, nothing).any()


def test_switched_off() -> None:
    loop = LoopConfig(feedforward_barometer=False, feedforward_temperature=False)
    assert not answered(loop, np.linspace(1e5, 1.1e5, 10), np.linspace(20, 30, 10)).any()


@pytest.mark.parametrize("lost", ["pressure", "temperature"])
def test_intermittent_sensor_causes_no_step(lost: str) -> None:
    """However far the value went meanwhile."""
    ramp = np.arange(600) * DT_S
    pressure_pa, air_c = 101_325.0 + 1.0 * ramp, 20.0 + 0.01 * ramp
    series = pressure_pa if lost == "pressure" else air_c
    series[200:400] = math.nan
    series[400:] += 50.0
    jumps = np.abs(np.diff(answered(LoopConfig(), pressure_pa, air_c)))
    steady = 0.358 * DT_S / 0.2 * 1.01
    assert jumps.max() < steady


@pytest.mark.parametrize("air_said_c", [85.0, -127.0, 1e308])
@pytest.mark.parametrize("pressure_said_pa", [0.0, 110_000.0, 1e308])
@pytest.mark.parametrize("until", [201, 400])
def test_a_sensor_that_fails_to_a_value_moves_nothing(
    air_said_c: float, pressure_said_pa: float, until: int
) -> None:
    """For one tick or for long, there and back again."""
    pressure_pa, air_c = np.full(600, 101_325.0), np.full(600, 20.0)
    pressure_pa[200:until], air_c[200:until] = pressure_said_pa, air_said_c
    assert not answered(LoopConfig(), pressure_pa, air_c).any()


def test_switching_feedforward_at_run_time_causes_no_step() -> None:
    feedforward, ramp = FeedForward(LoopConfig()), iter(range(10_000))
    flows = []
    for barometer in (True, False, True):
        feedforward.set_gains(LoopConfig(feedforward_barometer=barometer))
        flows += [
            feedforward.update(101_325.0 + 0.1 * next(ramp), math.nan, DT_S) for _ in range(200)
        ]
    assert np.abs(np.diff(flows)).max() < 0.358 * 5.0 * DT_S / 0.2 * 1.01
    assert flows[399] == pytest.approx(0.0, abs=1e-6)
    assert flows[599] == pytest.approx(0.358 * 5.0, rel=1e-3)


@pytest.mark.parametrize(
    ("pressure_pa", "air_c"), [(1013.25, 20.0), (101_325.0, 293.15), (14.7, math.nan)]
)
def test_a_weather_sensor_in_a_wrong_unit_is_ignored_and_reported(
    pressure_pa: float, air_c: float
) -> None:
    wave = np.sin(np.arange(200) / 10)
    wrong_pressure = explain_weather_fault(pressure_pa, 20.0) != ""
    pressure = pressure_pa + (wave if wrong_pressure else 0.0 * wave)
    air = air_c + (0.0 * wave if wrong_pressure else wave)
    assert not answered(LoopConfig(), pressure, air).any()
    assert "check its unit" in explain_weather_fault(pressure_pa, air_c)


@pytest.mark.parametrize(
    ("pressure_pa", "air_c"), [(101_325.0, 20.0), (54_000.0, -5.0), (math.nan, math.nan)]
)
def test_weather_within_habitable_ranges_is_accepted(pressure_pa: float, air_c: float) -> None:
    assert explain_weather_fault(pressure_pa, air_c) == ""
