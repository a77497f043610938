"""The aim of a loop whose pump often stands at its limit."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.control.limit_bias import LimitBias
from tests.studies.misstated_loops import (
    RATE_HZ,
    LoopBench,
    make_product_law,
    simulate_bench,
)

# A mirror that leaks little, in strong weather
TIGHT = LoopBench(leak_um_per_s=0.1, full_um_per_s=3.0, pressure_pa=3.0, laser_um=0.3)


def test_a_pump_within_its_range_leaves_the_aim_at_the_setpoint() -> None:
    bias = LimitBias()
    for _ in range(1000):
        bias.step(0.5, False, 0.1)
    assert bias.offset_um == 0.0


def test_a_start_far_from_the_setpoint_does_not_move_the_aim() -> None:
    bias = LimitBias()
    for _ in range(50):
        bias.step(20.0, True, 0.1)
    assert bias.offset_um == 0.0


def test_a_film_that_has_jumped_returns_without_moving_the_aim() -> None:
    bias = LimitBias()
    error_um = -50.0
    while error_um < 0.0:  # the leak lowers the mirror
        bias.step(error_um, True, 0.02)
        error_um += 1.0 * 0.02
    assert -0.1 < bias.offset_um < 0.0


def test_a_pump_that_cannot_hold_the_mirror_winds_the_aim_no_further_than_a_mean_error() -> None:
    bias = LimitBias()
    for _ in range(6000):
        bias.step(2.5, True, 0.1)
    assert bias.offset_um == pytest.approx(2.0)
    seconds = 0
    while bias.offset_um > 0.2:  # the pump holds again: the mirror stands at the aim
        bias.step(-bias.offset_um, False, 1.0)
        seconds += 1
    assert seconds < 120


def test_the_aim_returns_when_the_pump_is_in_its_range_again() -> None:
    bias = LimitBias(offset_um=-0.8, share=0.5)
    for _ in range(9000):
        bias.step(0.0, False, 0.1)
    assert -0.06 < bias.offset_um < 0.0


def test_a_tight_mirror_in_strong_weather_is_held_at_its_setpoint(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def find_mean_um() -> float:
        centre_um = simulate_bench(TIGHT, make_product_law(TIGHT), 1, 200.0)
        return float(np.mean(centre_um[round(100 * RATE_HZ) :]))

    corrected_um = find_mean_um()
    monkeypatch.setattr(LimitBias, "step", lambda *_: None)
    plain_um = find_mean_um()
    assert plain_um > 0.3
    assert abs(corrected_um) < 0.4 * plain_um
