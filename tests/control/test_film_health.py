"""Slow deterioration is reported early and once; healthy days give no warning."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from membrane_ctrl.control.film_health import FilmHealth
from membrane_ctrl.control.maintenance_notice import MaintenanceNotice

STEP_S = 60.0
HOURS = Callable[[float], float]


def days(leak: HOURS, pressure: HOURS, count: float) -> list[tuple[float, MaintenanceNotice]]:
    """Warnings with their hour."""
    health = FilmHealth(5.3)
    found = []
    for step in range(round(count * 24 * 60)):
        hour = step / 60
        found += [(hour, warning) for warning in health.step(STEP_S, leak(hour), pressure(hour))]
    return found


def creeping(hour: float) -> float:
    """600 Pa after a day under load, 0.5 % of compliance a decade."""
    return 600.0 / (1 + 0.005 * math.log10(1 + hour / 24))


def test_a_healthy_month_gives_no_warning() -> None:
    assert days(lambda h: 1.24 + 0.1 * math.sin(h / 4), creeping, 30) == []


def test_an_opening_seam_is_reported_days_before_the_pump_saturates() -> None:
    found = days(lambda h: 1.24 + 0.6 * h / 24, creeping, 6)
    assert [warning.name for _, warning in found] == ["leak_growth", "pump_reserve"]
    hour, warning = found[0]
    left_days = float(warning.message.split("for ")[1].split()[0])
    truly_left_days = (5.3 - 1.24) / 0.6 - hour / 24
    assert left_days == pytest.approx(truly_left_days, abs=0.2)
    assert truly_left_days > 4


def test_a_tight_film_and_a_yielding_film_are_each_reported_once() -> None:
    assert [w.name for _, w in days(lambda h: 0.2, creeping, 3)] == ["too_tight"]
    assert [w.name for _, w in days(lambda h: 1.24, lambda h: 600.0 * (1 - 0.02 * h / 24), 3)] == [
        "creep"
    ]


def test_a_warning_repeats_only_after_the_value_has_recovered() -> None:
    comes_and_goes = days(lambda h: 0.2 if h % 20 < 10 else 1.2, creeping, 2)
    assert [w.bad for _, w in comes_and_goes if w.name == "too_tight"] == [True, False] * 2 + [True]
    assert all("no longer" in w.message for _, w in comes_and_goes if not w.bad)
    near = days(lambda h: 0.39 if h % 4 < 2 else 0.41, creeping, 2)
    assert [w.name for _, w in near] == ["too_tight"]


def test_gaps_and_setpoint_changes_do_not_affect_film_health() -> None:
    health = FilmHealth(5.3)
    assert not any(health.step(STEP_S, math.nan, 600.0) for _ in range(200))
    for hour in range(48):
        if hour == 24:
            health.setpoint_moved()
        for _ in range(60):
            assert not health.step(STEP_S, 1.24, 600.0 if hour < 24 else 560.0)
