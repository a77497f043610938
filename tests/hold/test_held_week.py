"""The week in virtual time continues from its stored state, and its page adds up its hours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.controller.command import Command
from membrane_ctrl.sim.bench_events import Surroundings
from tests.studies.held_week import (
    DOOR_OPEN_S,
    DOOR_PA,
    Doors,
    HeldWeek,
    draw_upsets,
    load_week,
    save_week,
)
from tests.studies.held_week_page import format_page


def test_a_stored_week_continues_as_if_it_had_not_been_stopped(tmp_path: Path) -> None:
    week = HeldWeek(1, 0.01, tmp_path / "records")
    assert week.hold is not None
    for tick in range(60):
        week.run_tick((Command("hold", "a test"),) if tick == 0 else ())
    save_week(week, tmp_path / "state")
    continued = load_week(tmp_path / "state")
    for _ in range(30):
        rows = [each.run_tick(()).row.pack() for each in (week, continued)]  # type: ignore[union-attr]
        assert rows[0] == rows[1]


def test_a_door_changes_the_pressure_while_it_is_open() -> None:
    time_s = np.arange(0.0, 20.0, 0.5)
    zero = np.zeros(time_s.size)
    on = Surroundings(time_s, zero.copy(), zero, zero, zero, zero)
    Doors(np.array([5.0, 12.0])).apply(on)
    opened = ((time_s >= 5.0) & (time_s < 5.0 + DOOR_OPEN_S)) | (
        (time_s >= 12.0) & (time_s < 12.0 + DOOR_OPEN_S)
    )
    assert on.ambient_pa.tolist() == (DOOR_PA * opened).tolist()
    Doors(np.array([])).apply(on)


def test_failures_are_hours_apart_and_last_to_the_end() -> None:
    upsets = draw_upsets(1, 7.0)
    at_s = np.array([upset[0] for upset in upsets])
    assert np.diff(at_s).min() >= 7200.0
    assert at_s[-1] >= 7 * 86_400.0


def make_hour(hour: int, **changes: Any) -> dict[str, Any]:
    found: dict[str, Any] = {
        "hour": hour,
        "hold": 1,
        "ticks": 36_000,
        "held_s": 3600.0,
        "true_mean_um": 0.1,
        "true_std_um": 0.2,
        "furthest_um": 1.0,
        "away_um": 1.0,
        "leak_error_um_per_s": 0.0,
        "rss_mb": 250.0,
        "recorded_mb": 6.0 * (hour + 1),
        "cpu_s": 30.0 * (hour + 1),
        "upsets": {},
        "events": {},
        "faults": [],
    }
    return found | changes


def test_the_page_states_an_incomplete_week_and_names_its_faults() -> None:
    hours = [make_hour(hour) for hour in range(6)]
    hours.append(make_hour(6, true_mean_um=-0.1, furthest_um=9.0, faults=["7 s link_lost: gone"]))
    page = format_page(hours)
    assert "7 of 168 hours were run: **the week is not complete**" in page
    assert "recorded | 6.0 MB an hour" in page
    assert "| 6 to 7 | 3600 | -0.100 | 0.200 | 9.0; 1.0 |" in page
    assert "Faults: 7 s link_lost: gone." in page
    # standard deviation of all, with the hour whose mean is another one
    assert "+0.0714 µm; 0.212 µm" in page
    assert float(np.sqrt(0.2**2 + 0.1**2 - 0.0714**2)) == pytest.approx(0.212, abs=1e-3)
