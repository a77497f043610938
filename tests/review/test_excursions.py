"""Excursions from the band with and without an explanation."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.model.telemetry import COLUMN, Rows, get_column
from membrane_ctrl.review.events.found import find_events
from membrane_ctrl.review.events.found_event import FoundEvent
from membrane_ctrl.run_files.levels import TICK_FIELDS, first_level
from tests.worlds.nights import DOOR, Planted, night
from tests.worlds.synthetic_shape import from_estimates

BAND_UM = 2.0
AT_S = 1500.0


def found_in(rows: Rows, band_um: float = BAND_UM) -> list[FoundEvent]:
    return find_events(
        first_level({name: get_column(rows, name) for name in TICK_FIELDS}),
        from_estimates([]),
        band_um,
    )


def bumped(events: list[Planted], size_um: float, scenario: str = "typical") -> Rows:
    """The error goes and comes back within some 15 s, too slowly for a glitch."""
    rows, _ = night(31, 1.0, scenario, events)
    bump = size_um * np.exp(-0.5 * ((get_column(rows, "mono_s") - AT_S - 10) / 4) ** 2)
    rows[:, COLUMN["error_um"]] -= bump
    rows[:, COLUMN["displacement_um"]] += bump
    return rows


@pytest.mark.parametrize("size_um", [5.0, -5.0])
def test_an_excursion_without_a_cause_is_named(size_um: float) -> None:
    (found,) = found_in(bumped([], size_um))
    assert (found.kind, found.unit) == ("excursion", "µm")
    assert found.time_s == pytest.approx(AT_S + 5, abs=3.0)
    assert found.size == pytest.approx(-size_um, abs=1.2)


def test_the_band_is_the_runs() -> None:
    rows = bumped([], 5.0)
    assert found_in(rows, 7.0) == []
    assert found_in(rows, float("inf")) == []


def test_a_door_and_a_fault_explain_it() -> None:
    assert [f.kind for f in found_in(bumped([Planted(DOOR, AT_S + 2, 12.0)], 5.0))] == [DOOR]
    rows = bumped([], 5.0)
    time_s = get_column(rows, "mono_s")
    rows[(time_s >= AT_S) & (time_s < AT_S + 3), COLUMN["fault"]] = 10
    assert found_in(rows) == []


def test_a_pause_explains_it() -> None:
    """A loop that waits has no estimate of the leak."""
    rows = bumped([], 5.0)
    time_s = get_column(rows, "mono_s")
    paused = (time_s >= AT_S - 30) & (time_s < AT_S)
    rows[paused, COLUMN["leak_um_per_s"]] = np.nan
    assert found_in(rows) == []


@pytest.mark.parametrize("to_um", [20.0, -20.0, 3.0])
def test_a_setpoint_on_its_way_explains_it(to_um: float) -> None:
    rows = bumped([], 5.0)
    over_s = abs(to_um) / 3.5
    moved_um = np.interp(get_column(rows, "mono_s"), [AT_S, AT_S + over_s], [0.0, to_um])
    for name in ("setpoint_um", "displacement_um", "filtered_um"):
        rows[:, COLUMN[name]] += moved_um
    assert found_in(rows) == []


def test_one_that_is_not_held_is_none() -> None:
    rows = bumped([], 5.0)
    rows[get_column(rows, "mono_s") < AT_S + 60, COLUMN["state"]] = 3
    assert "excursion" not in {f.kind for f in found_in(rows)}


@pytest.mark.parametrize("scenario", ["quiet", "typical", "gusty"])
def test_weather_leaves_the_mirror_in_its_band(scenario: str) -> None:
    rows, _ = night(32, 4.0, scenario, [])
    assert found_in(rows) == []
