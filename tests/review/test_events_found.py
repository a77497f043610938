"""Events found in simulated nights, and silence where there are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.telemetry import COLUMN, Rows, State, get_column
from membrane_ctrl.review.events.found import (
    find_events,
    find_laser_losses,
    find_noise_changes,
    find_weather_losses,
)
from membrane_ctrl.review.events.found_event import FoundEvent
from membrane_ctrl.review.events.steps import find_steps, step_confidence
from membrane_ctrl.run_files.levels import TICK_FIELDS, Columns, first_level
from tests.studies.events_found import matched
from tests.worlds.nights import DOOR, GLITCH, JUMP, LATE, LEAK, LOST, Planted, night
from tests.worlds.synthetic_shape import from_estimates

HOURS = 2.0


def level_of(rows: Rows) -> Columns:
    return first_level({name: get_column(rows, name) for name in TICK_FIELDS})


def found_in(events: list[Planted], seed: int = 1, scenario: str = "typical") -> list[FoundEvent]:
    rows, shapes = night(seed, HOURS, scenario, events)
    return find_events(level_of(rows), from_estimates(shapes), 2.0)


@pytest.mark.parametrize("scenario", ["quiet", "typical", "gusty"])
def test_a_calm_night_raises_no_alarm(scenario: str) -> None:
    assert found_in([], scenario=scenario) == []


@pytest.mark.parametrize(
    "event",
    [
        Planted(DOOR, 3000.4, 10.0),
        Planted(DOOR, 3000.9, -12.0),
        Planted(LEAK, 3000.0, 30.0),
        Planted(LEAK, 3000.0, -30.0),
        Planted(GLITCH, 3000.3, 15.0),
        Planted(GLITCH, 3000.3, -15.0),
        Planted(LOST, 3000.0, 2.0),
        Planted(LATE, 3000.0, 30.0),
        Planted(JUMP, 3000.0, 1.0),
    ],
    ids=lambda event: f"{event.kind} {event.size:g}",
)
def test_what_was_planted_is_found_and_nothing_else(event: Planted) -> None:
    found = found_in([event])
    missed, false = matched([event], found)
    assert (missed, false) == ([], [])
    one = next(item for item in found if item.kind == event.kind)
    assert one.confidence > 0.99
    assert one.start_s < event.time_s < one.end_s
    if event.kind in {DOOR, LEAK, GLITCH}:
        assert one.size == pytest.approx(event.size, rel=0.35)


def test_a_change_of_noise_is_found() -> None:
    rows, _ = night(3, HOURS, "typical", [])
    later = get_column(rows, "mono_s") > 3600
    rows[later, COLUMN["error_um"]] *= 2.5
    found = find_noise_changes(level_of(rows))
    assert [round(item.size, 1) for item in found] == [pytest.approx(2.5, rel=0.2)]
    assert abs(found[0].time_s - 3600) < 300


@pytest.mark.parametrize(
    ("field", "kind"),
    [("ambient_pressure_pa", "barometer lost"), ("air_temperature_c", "thermometer lost")],
)
def test_lost_weather_is_found_once_it_was_there(field: str, kind: str) -> None:
    rows, _ = night(4, 0.2, "quiet", [])
    time_s = get_column(rows, "mono_s")
    rows[
        (time_s < 20.0) | ((time_s >= 300.0) & (time_s < 360.0)) | (time_s == 100.0), COLUMN[field]
    ] = np.nan
    (found,) = find_weather_losses(level_of(rows))
    assert (found.kind, found.time_s, found.size) == (kind, 300.0, 60.0)
    rows[:, COLUMN[field]] = np.nan  # a bench without one
    assert find_weather_losses(level_of(rows)) == []


@pytest.mark.parametrize(("quality", "kind"), [(0.0, "laser lost"), (np.nan, "optics lost")])
def test_what_a_bench_is_held_by_is_what_it_has_lost(quality: float, kind: str) -> None:
    rows, _ = night(4, 0.2, "quiet", [])
    rows[:, COLUMN["displacement_quality"]] = quality  # figures have no code
    time_s = get_column(rows, "mono_s")
    rows[(time_s >= 300.0) & (time_s < 304.0), COLUMN["displacement_um"]] = np.nan
    (found,) = find_laser_losses(level_of(rows))
    assert (found.kind, found.time_s, found.size) == (kind, 300.0, 4.0)


def test_a_step_and_a_gap() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=2000)
    values[1200:] += 20.0
    values[500:520] = np.nan
    found = find_steps(values, half=3, skip=1, least=5.0, least_sigmas=6.0)
    assert [step.row for step in found] == [pytest.approx(1200, abs=2)]
    assert found[0].size == pytest.approx(20.0, abs=2.0)
    assert find_steps(values[:5], 3, 1, 1.0, 1.0) == []


def test_confidence_falls_with_the_places_looked_at() -> None:
    assert step_confidence(6.0, 1000) > 0.99999
    assert step_confidence(3.0, 1) == pytest.approx(0.9973, abs=1e-4)
    assert step_confidence(3.0, 10_000) == 0.0


def test_a_mirror_that_is_moved_makes_no_jump_of_its_figure() -> None:
    """A deeper bowl has more of Z11, and frames of a bowl that moves have some of Z6; inflating is
    no event.
    """
    rows, shapes = night(1, 0.5, "quiet", [])
    time_s = get_column(rows, "mono_s")
    moved_um = np.interp(time_s, [300, 317, 1000, 1017], [0, 60, 60, 0])
    rows[:, COLUMN["state"]] = np.where(time_s < 200, State.INFLATE, State.HOLD)
    estimates = []
    for estimate in shapes:
        at_um = float(np.interp(estimate.time_s, time_s, moved_um))
        speed = float(np.interp(estimate.time_s, time_s, np.gradient(moved_um, time_s)))
        coeffs_um = estimate.coeffs_um + zernike_projection() * at_um
        coeffs_um[5] += 2.0 * (estimate.time_s < 150) + 0.3 * speed
        displacement_um = estimate.displacement_um + at_um
        sag_um = estimate.sag_um + at_um
        estimates.append(
            replace(estimate, coeffs_um=coeffs_um, sag_um=sag_um, displacement_um=displacement_um)
        )
    found = find_events(level_of(rows), from_estimates(estimates), 2.0)
    assert [event for event in found if event.kind == JUMP] == []
