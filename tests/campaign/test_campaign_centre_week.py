"""Hours of a hold by the estimate in which sensors are lost and come back, knocks, drifts and leaks
happen.
"""

from __future__ import annotations

import pytest

from tests.studies.centre_week import BUMP_UM, days

DAYS = 0.12  # 50 s of CPU time


@pytest.mark.campaign
@pytest.mark.timeout(1800)
def test_hours_in_which_everything_happens_to_the_sensors() -> None:
    day = days(DAYS, 1)
    assert len(day.changes) > 15
    assert day.faults == []
    assert day.missed == 0
    assert day.held_s > 0.999 * DAYS * 86_400
    assert [change for change in day.changes if change.bump_um > BUMP_UM] == []
    assert [change for change in day.changes if not change.told_once] == []
    assert day.hour_um < 0.08
