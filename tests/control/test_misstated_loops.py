"""The bench and the laws of the study of misstated loops, and a few of its draws."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.studies import misstated_loops
from tests.studies.misstated_loops import (
    LoopBench,
    Readings,
    draw_misstatement,
    make_lqg_law,
    make_product_law,
    measure_std,
    simulate_bench,
)

CALM = LoopBench(pressure_pa=1e-9, air_k=1e-9, laser_um=1e-9, barometer_pa=1e-9, thermometer_k=1e-9)


def test_the_bench_integrates_flow_less_leak_after_dead_time_and_lag() -> None:
    def law(_: float, given: Readings) -> float:
        return 2 * CALM.leak_um_per_s / CALM.full_um_per_s

    centre_um = simulate_bench(CALM, law, 1, 3.0)
    late_s = CALM.delay_s + CALM.lag_s
    assert centre_um[-1] == pytest.approx(CALM.leak_um_per_s * (3.0 - 0.02 - late_s), abs=0.02)


def test_the_regulator_holds_a_bench_and_uses_the_thermometer() -> None:
    bench = LoopBench(pressure_pa=0.1)
    right_um = measure_std(bench, make_lqg_law(bench, 0.003), 3, 30.0)
    blind = LoopBench(pressure_pa=0.1, warmth_gain_um_per_k=1.0)
    assert right_um < 0.1
    assert right_um < 0.6 * measure_std(bench, make_lqg_law(blind, 0.003), 3, 30.0)


def test_a_loop_that_runs_away_is_unstable() -> None:
    assert math.isinf(measure_std(CALM, lambda *_: 1.0, 1, 10.0))


def test_every_figure_of_a_draw_is_wrong_within_its_bound() -> None:
    true = LoopBench()
    drawn = [draw_misstatement(true, seed) for seed in range(50)]
    off = np.array([each.delay_s for each in drawn]) / true.delay_s - 1
    assert 0.2 < np.abs(off).max() <= 0.3
    assert len({each.full_um_per_s for each in drawn}) == 50


def test_a_misled_loop_stays_near_one_that_is_told_right(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(misstated_loops, "SETTLED_S", 20.0)
    bench, draw = LoopBench(), 3
    right_um = measure_std(bench, make_product_law(bench), draw, 15.0)
    stated = draw_misstatement(bench, draw)
    assert measure_std(bench, make_product_law(stated), draw, 15.0) < 1.5 * right_um


@pytest.mark.campaign
@pytest.mark.timeout(300)
@pytest.mark.parametrize("draw", range(10))
def test_misled_loops_stay_within_half_more(draw: int) -> None:
    bench = LoopBench()
    right_um = measure_std(bench, make_product_law(bench), draw, 100.0)
    stated = draw_misstatement(bench, draw)
    assert measure_std(bench, make_product_law(stated), draw, 100.0) <= 1.5 * right_um
