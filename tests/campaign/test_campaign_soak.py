"""Demands on days of simulated weather: the true centre in its bands, and memory flat."""

from __future__ import annotations

import pytest

from tests.studies.soak import dropout_excursions_um, everything, soak


def test_ten_seconds_without_a_laser() -> None:
    assert max(dropout_excursions_um(range(12, 18))) < 4.0


@pytest.mark.campaign
@pytest.mark.timeout(900)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_day_of_typical_weather_with_the_defaults(seed: int) -> None:
    day = soak(1.0, seed, faults=False)
    assert day.second.count > 86_000
    assert day.second.fraction >= 0.999
    assert day.minute.worst_um < 0.45  # of 0.5


@pytest.mark.campaign
@pytest.mark.timeout(900)
def test_a_day_with_faults_at_random_is_held_and_memory_stays() -> None:
    day = soak(1.0, 4, True, everything(4))
    assert day.events["fault"] >= 3
    assert day.held_s > 0.98 * 86_400
    assert day.second.fraction >= 0.999
    assert day.rss_mb < 1.05 * day.rss_after_hour_mb
