"""What each state waits for before it is left, played on the virtual bench at 10 Hz."""

from __future__ import annotations

from typing import Any

import pytest

from membrane_ctrl.names import State
from membrane_ctrl.virtual.scenario import Outcome, Scenario, play


def played(*at: dict[str, Any], duration_s: float = 60.0, **config: Any) -> Outcome:
    states = {"stay_after_trip": True, **config.pop("states", {})}
    config = {"loop": {"rate_hz": 10.0}, "states": states, **config}
    return play(
        Scenario.model_validate(
            {"title": "states", "duration_s": duration_s, "config": config, "at": at, "expect": {}}
        )
    )


def changes(outcome: Outcome, state: str) -> list[float]:
    """When a state was entered, s."""
    return [event["mono_s"] for event in outcome.of("state") if event["state"] == state]


def test_an_acknowledged_fault_is_left_only_when_the_pump_is_seen_to_be_off() -> None:
    """The read-back says 0.5 from 20 s to 35 s; after `lower_timeout_s` on the rung nobody waits for it any more."""
    outcome = played(
        {"time_s": 20.0, "wrong": "gauge_lost"},
        {"time_s": 22.0, "wrong": "readback_fraction", "value": 0.5, "for_s": 13.0},
        {"time_s": 25.0, "command": "ack"},
        states={"ramp_down_s": 1.0, "lower_timeout_s": 30.0},
    )
    (standby_s,) = changes(outcome, "standby")
    assert 35.0 <= standby_s < 35.3


def test_a_resume_waits_for_the_pump_to_be_seen_off() -> None:
    outcome = played(
        {"time_s": 20.0, "wrong": "unreachable", "for_s": 2.0},
        {"time_s": 22.0, "wrong": "readback_fraction", "value": 0.5, "for_s": 15.0},
        states={"lower_timeout_s": 30.0},
        resume={"faults": ["link_lost"], "wait_s": 5.0},
    )
    assert 37.0 <= changes(outcome, "standby")[0] < 43.0


def test_the_ramp_down_is_a_straight_line() -> None:
    outcome = played({"time_s": 20.0, "wrong": "gauge_lost"}, states={"ramp_down_s": 10.0})
    (fault_s,) = changes(outcome, "fault")
    rows = [tick.row for tick in outcome.ticks]
    before = [row.pump_fraction for row in rows if row.mono_s < fault_s][-1]
    for row in rows:
        if fault_s <= row.mono_s < fault_s + 10.0:
            assert row.pump_fraction == pytest.approx(before * (1.0 - (row.mono_s - fault_s) / 10.0), abs=1e-6)


def test_a_pause_that_nobody_ends_ends_itself() -> None:
    outcome = played({"time_s": 20.0, "command": "pause"}, states={"pause_max_s": 15.0})
    paused = [tick.row.mono_s for tick in outcome.ticks if tick.row.mono_s > 20.5 and tick.row.p_um_per_s == 0.0]
    assert 34.5 < max(second for second in paused if second < 50.0) < 35.5


@pytest.mark.parametrize(
    ("at", "config"),
    [
        ([{"time_s": 25.0, "command": "lower"}, {"time_s": 30.0, "command": "hold"}], {}),
        (
            [{"time_s": 25.0, "wrong": "unreachable", "for_s": 1.0}],
            {"resume": {"faults": ["link_lost"], "wait_s": 2.0}},
        ),
    ],
)
@pytest.mark.parametrize("wish", [{"command": "manual", "value": 3.0}, {"command": "pause"}])
def test_what_was_asked_of_a_hold_is_not_asked_of_the_next(
    wish: dict[str, Any], at: list[dict[str, Any]], config: dict[str, Any]
) -> None:
    outcome = played({"time_s": 20.0, **wish}, *at, **config)
    assert changes(outcome, "hold")[-1] > 30.0
    assert all(manual_s < 25.0 for manual_s in changes(outcome, "manual"))
    assert "paused" not in [event["why"] for event in outcome.of("why")][-1]


def test_what_is_called_hold_has_been_inside_the_band_for_settle_s() -> None:
    outcome = played(states={"settle_s": 6.0}, duration_s=40.0)
    settle_s, hold_s = changes(outcome, "settle")[0], changes(outcome, "hold")[0]
    assert hold_s - settle_s >= 6.0
    errors_um = [tick.row.error_um for tick in outcome.ticks if hold_s - 6.0 < tick.row.mono_s < hold_s]
    assert max(map(abs, errors_um)) < 2.0


def test_venting_without_a_gauge_goes_on() -> None:
    outcome = played({"time_s": 20.0, "wrong": "gauge_lost"}, {"time_s": 20.0, "command": "vent"}, duration_s=40.0)
    rows = [tick.row for tick in outcome.ticks if 21.0 < tick.row.mono_s < 40.0]
    assert {row.state for row in rows} == {State.LOWER}
    assert {row.vent_fraction for row in rows} == {1.0}


def test_a_vent_that_does_not_empty_the_bowl_is_told_of() -> None:
    outcome = played({"time_s": 20.0, "wrong": "gauge_lost"}, {"time_s": 20.0, "command": "vent"}, duration_s=950.0)
    (told,) = [event for event in outcome.of("why") if "see whether the vent opens" in event["why"]]
    assert 920.0 <= told["mono_s"] < 930.0
    assert not changes(outcome, "standby")


def test_a_stop_is_the_last_word() -> None:
    """A `lower` in the same tick makes no standby of the stop."""
    outcome = played(
        {"time_s": 19.0, "wrong": "readback_fraction", "value": 0.5, "for_s": 2.5},
        {"time_s": 20.0, "command": "stop"},
        {"time_s": 20.0, "command": "lower"},
    )
    assert outcome.ticks[-1].outputs.finished is not None
    assert outcome.ticks[-1].row.mono_s < 24.0
    assert not changes(outcome, "standby")


def test_a_board_that_has_latched_a_fault_is_not_held_with() -> None:
    """Its own limit is 800 Pa; here ours is higher, and the check has to see the board's bit."""
    outcome = played(
        {"time_s": 0.5, "wrong": "gauge_offset_pa", "value": 300.0, "for_s": 1.0},
        duration_s=20.0,
        limits={"gauge_pressure_max_pa": 2000.0},
    )
    assert not changes(outcome, "inflate")
    assert [event["name"] for event in outcome.of("fault")] == ["overdue"]
