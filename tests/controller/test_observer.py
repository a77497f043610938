"""Which readings count as new, and when a jump is accepted."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from firmware_iface.roles import BenchReading
from membrane_ctrl.config.schema import Config, EstimatorConfig, ShapeConfig
from membrane_ctrl.controller.observation import Observation
from membrane_ctrl.controller.observer import Observer
from membrane_ctrl.controller.tick import TickInputs
from tests.worlds.sound_figure import SOUND_FIGURE


def look(
    observer: Observer, tick: int, displacement_um: float, counter: int, device_time_s: float
) -> Observation:
    reading = BenchReading(
        displacement_um, 0, 600.0, 101325.0, 23.0, 23.0, 0.0, 0.0, counter, device_time_s, False, 0
    )
    inputs = TickInputs(now_s=0.02 * tick, dt_s=0.02, reading=reading, link_up=True)
    observer.observe_inputs(inputs)
    return observer.make_observation(inputs, math.nan)


def test_a_sample_is_new_only_when_counter_and_time_have_both_advanced() -> None:
    observer = Observer(Config())
    stamps = [(1, 0.1), (2, 0.1), (1, 0.2), (2, 0.2)]
    valid = [
        look(observer, tick, 0.1 * tick, *stamp).displacement_valid
        for tick, stamp in enumerate(stamps, 1)
    ]
    assert valid == [True, False, False, True]


def test_a_jump_is_accepted_after_ten_refused_readings() -> None:
    observer = Observer(Config())
    look(observer, 1, 0.0, 1, 0.02)
    valid = [
        look(observer, tick, 200.0, tick, 0.02 * tick).displacement_valid for tick in range(2, 14)
    ]
    assert valid == [False] * 10 + [True] * 2


def gauge(observer: Observer, tick: int, gauge_pa: float) -> Observation:
    reading = BenchReading(
        0.1 * (tick % 2), 0, gauge_pa, 101325.0, 23.0, 23.0, 0.0, 0.0, tick, 0.1 * tick, False, 0
    )
    inputs = TickInputs(now_s=0.1 * tick, dt_s=0.1, reading=reading, link_up=True)
    observer.observe_inputs(inputs)
    return observer.make_observation(inputs, math.nan)


def test_a_gauge_that_repeats_itself_is_timed_and_any_change_ends_it() -> None:
    observer = Observer(Config())
    same_s = [gauge(observer, tick, 600.0).gauge_same_s for tick in range(1, 12)]
    assert same_s[0] == 0.0
    assert math.isclose(same_s[-1], 1.0)
    assert gauge(observer, 12, 600.001).gauge_same_s == 0.0
    assert math.isclose(gauge(observer, 13, math.nan).gauge_same_s, 0.0)


def test_the_gauge_of_a_slack_film_may_repeat_its_zero() -> None:
    observer = Observer(Config())
    assert {gauge(observer, tick, 0.0).gauge_same_s for tick in range(1, 100)} == {0.0}


def test_a_jump_of_the_gauge_is_accepted_after_ten_refused_readings() -> None:
    observer = Observer(Config())
    gauge(observer, 1, 600.0)
    jumps = [gauge(observer, tick, 500.0 + 0.1 * tick).gauge_jumps for tick in range(2, 14)]
    assert jumps == [*range(1, 11), 0, 0]


def test_a_jumping_gauge_is_not_compared_but_still_checked_against_its_limits() -> None:
    observer = Observer(Config())
    gauge(observer, 1, 600.0)
    seen = gauge(observer, 2, 2000.0)
    assert seen.gauge_pressure_pa == 2000.0
    assert math.isnan(observer.gauge_pressure_pa)
    gauge(observer, 3, 600.5)
    assert observer.gauge_pressure_pa == 600.5


def test_a_read_back_of_nan_counts_as_a_mismatch() -> None:
    observer = Observer(Config())
    reading = BenchReading(0.0, 0, 600.0, 101325.0, 23.0, 23.0, 0.0, 0.0, 1, 0.02, False, 0)
    for tick, (pump, mismatch) in enumerate(((0.0, 0.0), (0.3, 0.3), (math.nan, math.inf)), 1):
        inputs = TickInputs(0.02 * tick, 0.02, replace(reading, pump_fraction=pump))
        observer.observe_inputs(inputs)
        assert observer.make_observation(inputs, math.nan).pump_mismatch == mismatch


@pytest.mark.parametrize("may_follow_optics", [True, False])
def test_figures_replace_a_lost_laser_only_if_the_estimate_uses_them(
    may_follow_optics: bool,
) -> None:
    config = Config(
        estimator=EstimatorConfig(process_value="estimate"),
        shape=ShapeConfig(mode="track", track_rate_hz=10.0),
    )
    observer = Observer(config)
    lit = BenchReading(0.0, 0, 600.0, 101325.0, 23.0, 23.0, 0.0, 0.0, 0, 0.0, False, 0)
    for tick in range(1, 200):
        now_s = 0.1 * tick
        laser_um = math.nan if tick > 150 else 0.01 * (tick % 2)
        reading = replace(lit, displacement_um=laser_um, sample_counter=tick, device_time_s=now_s)
        figure = replace(SOUND_FIGURE, time_s=now_s, sag_um=SOUND_FIGURE.sag_um + 0.01 * (tick % 3))
        inputs = TickInputs(now_s=now_s, dt_s=0.1, reading=reading, link_up=True, estimate=figure)
        observer.observe_inputs(inputs, may_follow_optics)
        if tick == 150:
            assert not observer.optics_replace_laser
    assert observer.optics_replace_laser is may_follow_optics
    assert math.isfinite(observer.displacement_um) is may_follow_optics
    assert math.isfinite(observer.optics_guard_um) is may_follow_optics
