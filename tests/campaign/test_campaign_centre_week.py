"""Hours of a hold by the estimate in which sensors are lost and come back, knocks, drifts and leaks happen."""

from __future__ import annotations

import pytest

from benchmarks.centre_week import BUMP_UM, days

DAYS = 0.2  # 60 s of CPU time


@pytest.mark.campaign
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", [1, 2])
def test_hours_in_which_everything_happens_to_the_sensors(seed: int) -> None:
    day = days(DAYS, seed)
    assert len(day.changes) > 20
    assert day.faults == []
    assert day.missed == 0
    assert day.held_s > 0.999 * DAYS * 86_400
    assert [change for change in day.changes if change.bump_um > 1.3 * BUMP_UM] == []
    assert day.hour_um < 0.08
