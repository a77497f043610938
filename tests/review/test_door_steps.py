"""Doors in the air pressure, quick and slow, by barometers of all kinds."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.model.telemetry import COLUMN, Rows, get_column
from membrane_ctrl.review.events.door_steps import reading_resolution_pa, update_s
from membrane_ctrl.review.events.found import pressure_steps
from membrane_ctrl.review.events.found_event import FoundEvent
from membrane_ctrl.run_files.levels import TICK_FIELDS, first_level
from tests.worlds.nights import DOOR, Planted, night

HOURS = 2.0
AMBIENT = COLUMN["ambient_pressure_pa"]


def doors_in(rows: Rows) -> list[FoundEvent]:
    return pressure_steps(first_level({name: get_column(rows, name) for name in TICK_FIELDS}))


def repeated(rows: Rows, period_s: float) -> None:
    """What a barometer gives that measures so seldom, in the middle of a second."""
    tick, period = np.arange(len(rows)), round(10 * period_s)
    rows[:, AMBIENT] = rows[np.maximum((tick + 3) // period * period - 3, 0), AMBIENT]


@pytest.mark.parametrize("period_s", [1.0, 2.5, 5.0, 10.0, 60.0])
@pytest.mark.parametrize("quantum_pa", [0.0, 1.0])
def test_a_slow_barometer_makes_no_steps_of_gusts(period_s: float, quantum_pa: float) -> None:
    rows, _ = night(7, HOURS, "gusty", [])
    repeated(rows, period_s)
    if quantum_pa:
        rows[:, AMBIENT] = np.round(rows[:, AMBIENT] / quantum_pa) * quantum_pa
    assert doors_in(rows) == []


@pytest.mark.parametrize("scenario", ["quiet", "typical", "gusty"])
def test_a_coarse_barometer_makes_no_steps_of_its_rounding(scenario: str) -> None:
    rows, _ = night(8, HOURS, scenario, [])
    rows[:, AMBIENT] = np.round(rows[:, AMBIENT] / 10.0) * 10.0
    assert doors_in(rows) == []


def test_a_slow_and_coarse_barometer_shows_a_door() -> None:
    rows, _ = night(9, HOURS, "typical", [Planted(DOOR, 3000.0, 30.0)])
    repeated(rows, 5.0)
    rows[:, AMBIENT] = np.round(rows[:, AMBIENT] / 5.0) * 5.0
    (found,) = doors_in(rows)
    assert found.time_s == pytest.approx(3002.5, abs=3.5)
    assert found.size == pytest.approx(30.0, abs=6.0)


@pytest.mark.parametrize("over_s", [0.1, 1.0, 3.0, 5.0])
@pytest.mark.parametrize("size_pa", [10.0, -25.0])
def test_a_door_that_takes_its_time_has_its_size(over_s: float, size_pa: float) -> None:
    rows, _ = night(10, HOURS, "typical", [])
    rows[:, AMBIENT] += size_pa * np.clip((get_column(rows, "mono_s") - 3000.3) / over_s, 0, 1)
    (found,) = doors_in(rows)
    assert found.time_s == pytest.approx(3000.3 + over_s / 2, abs=3.0)
    assert found.size == pytest.approx(size_pa, abs=2.0)


@pytest.mark.parametrize("open_s", [1.0, 2.0, 3.0, 6.0])
def test_a_door_that_is_closed_at_once_is_two_steps(open_s: float) -> None:
    rows, _ = night(
        11, HOURS, "typical", [Planted(DOOR, 3000.4, 20.0), Planted(DOOR, 3000.4 + open_s, -20.0)]
    )
    up, down = doors_in(rows)
    assert up.size > 9.0
    assert down.size < -9.0
    assert up.time_s == pytest.approx(3000.4, abs=1.5)
    assert down.time_s == pytest.approx(3000.4 + open_s, abs=1.5)


def test_rate_and_resolution_of_a_barometer_are_found() -> None:
    fine = np.cumsum(np.random.default_rng(12).normal(size=3000)) + 1e5
    assert update_s(fine) == 1
    assert update_s(np.repeat(fine, 7)) == 7
    assert update_s(np.full(100, np.nan)) == 1
    assert update_s(np.repeat([1e5, 1e5 + 20.0], 1000)) == 1
    assert reading_resolution_pa(np.round(fine / 4) * 4) == pytest.approx(4.0)
    assert reading_resolution_pa(fine) < 0.1
    assert reading_resolution_pa(np.full(100, np.nan)) == 0.0
