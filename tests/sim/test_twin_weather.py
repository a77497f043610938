"""Days and weather: what they do to the surroundings, whatever blocks they are made in."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.sim.bench_events import (
    BenchEvent,
    DailyTemperature,
    PressureWeather,
    Surroundings,
)

DAY_S = 86_400.0


def series(event: BenchEvent, time_s: np.ndarray) -> Surroundings:
    zero = np.zeros_like(time_s)
    on = Surroundings(
        time_s, zero.copy(), zero.copy(), np.ones_like(time_s), zero.copy(), zero.copy()
    )
    event.apply(on)
    return on


def test_the_room_is_warmest_in_the_afternoon() -> None:
    time_s = np.arange(0.0, 2 * DAY_S, 60.0)
    air_k = series(DailyTemperature(1.5), time_s).air_k
    assert time_s[np.argmax(air_k)] == pytest.approx(15 * 3600, abs=60)
    assert np.ptp(air_k) == pytest.approx(3.0, abs=1e-3)


def test_weather_has_its_size_begins_at_nothing_and_is_slow() -> None:
    time_s = np.arange(0.0, 60 * DAY_S, 600.0)
    stds = []
    for seed in range(8):
        ambient_pa = series(PressureWeather(700.0, seed), time_s).ambient_pa
        assert ambient_pa[0] == pytest.approx(0.0, abs=1e-9)
        stds.append(ambient_pa.std())
        assert np.max(np.abs(np.diff(ambient_pa))) < 100.0  # Pa in ten minutes
    assert np.mean(stds) == pytest.approx(
        700.0, rel=0.2
    )  # few of the slow waves fit into two months


@pytest.mark.parametrize("event", [DailyTemperature(1.0), PressureWeather(500.0, 3)])
def test_blocks_make_no_difference(event: BenchEvent) -> None:
    time_s = np.arange(0.0, 4000.0, 1.0)
    whole = series(event, time_s)
    parts = [series(event, part) for part in np.split(time_s, 8)]
    assert np.array_equal(whole.ambient_pa, np.concatenate([part.ambient_pa for part in parts]))
    assert np.array_equal(whole.air_k, np.concatenate([part.air_k for part in parts]))
