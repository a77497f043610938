"""Laser glitches of all lengths, and other events."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.model.telemetry import COLUMN, Rows, get_column
from membrane_ctrl.review.events.found import find_laser_glitches
from membrane_ctrl.review.events.found_event import FoundEvent
from membrane_ctrl.run_files.levels import TICK_FIELDS, first_level
from tests.worlds.nights import DOOR, GLITCH, Planted, night

HOURS = 2.0
AT_S = 3000.3
READING = COLUMN["displacement_um"]


def glitches_in(rows: Rows) -> list[FoundEvent]:
    return find_laser_glitches(first_level({name: get_column(rows, name) for name in TICK_FIELDS}))


def wrong_for(rows: Rows, size_um: float, lasts_s: float) -> None:
    """A reading that is wrong for a while; the loop takes it back at the leak's speed, and
    afterwards again.
    """
    time_s = get_column(rows, "mono_s")
    there = (time_s >= AT_S) & (time_s < AT_S + lasts_s)
    taken = np.minimum(1.2 * np.clip(time_s - AT_S, 0, lasts_s), abs(size_um))
    taken -= np.minimum(1.2 * np.clip(time_s - AT_S - lasts_s, 0, None), taken)
    rows[:, READING] += np.sign(size_um) * (abs(size_um) * there - taken)


@pytest.mark.parametrize("size_um", [10.0, -12.0, 40.0])
@pytest.mark.parametrize("lasts_s", [0.1, 0.5, 1.0, 2.0, 3.0, 10.0, 30.0])
def test_a_glitch_is_found_once_however_long(size_um: float, lasts_s: float) -> None:
    rows, _ = night(21, HOURS, "typical", [])
    wrong_for(rows, size_um, lasts_s)
    (found,) = glitches_in(rows)
    assert found.time_s == pytest.approx(AT_S, abs=1.5)
    assert found.size == pytest.approx(size_um, rel=0.35)
    assert found.end_s > AT_S + lasts_s


@pytest.mark.parametrize("open_s", [1.0, 3.0, 20.0])
@pytest.mark.parametrize("period_s", [0.1, 10.0])
def test_a_door_is_no_glitch(open_s: float, period_s: float) -> None:
    events = [Planted(DOOR, AT_S, 35.0), Planted(DOOR, AT_S + open_s, -35.0)]
    rows, _ = night(22, HOURS, "typical", events)
    pressure = COLUMN["ambient_pressure_pa"]
    period = round(10 * period_s)
    rows[:, pressure] = rows[np.arange(len(rows)) // period * period, pressure]
    if open_s > period_s:
        assert glitches_in(rows) == []
    if open_s > 1.0:  # within a second nobody can know
        rows[:, pressure] = np.nan
        assert glitches_in(rows) == []


def test_a_loop_that_follows_at_full_speed_does_not_end_a_glitch() -> None:
    rows, _ = night(25, HOURS, "typical", [])
    time_s = get_column(rows, "mono_s")
    there = (time_s >= AT_S) & (time_s < AT_S + 8)
    after = 12.0 * (time_s >= AT_S + 8) - 1.2 * np.clip(time_s - AT_S - 8, 0, 10)
    rows[:, READING] += there * np.minimum(0.0, -12.0 + 4.0 * (time_s - AT_S)) + after
    (found,) = glitches_in(rows)
    assert (found.time_s, found.size) == (
        pytest.approx(AT_S, abs=1.0),
        pytest.approx(-12.0, rel=0.4),
    )
    assert found.end_s > AT_S + 8 + 25


def test_two_glitches_are_two() -> None:
    rows, _ = night(26, HOURS, "typical", [])
    time_s = get_column(rows, "mono_s")
    for at_s in (AT_S, AT_S + 15):
        rows[(time_s >= at_s) & (time_s < at_s + 4), READING] += 10.0
    assert [round(g.time_s - AT_S) for g in glitches_in(rows)] == [
        pytest.approx(0, abs=1),
        pytest.approx(15, abs=1),
    ]


def test_a_reading_that_stays_away_is_no_glitch() -> None:
    rows, _ = night(23, HOURS, "typical", [])
    rows[get_column(rows, "mono_s") > AT_S, READING] += 10.0
    assert glitches_in(rows) == []


def test_no_reading_at_all() -> None:
    rows, _ = night(24, 0.1, "typical", [Planted(GLITCH, 100.0, 20.0)])
    assert len(glitches_in(rows)) == 1
    rows[:, READING] = np.nan
    assert glitches_in(rows) == []
