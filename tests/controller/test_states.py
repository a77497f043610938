"""Conditions of each state's transitions, on the virtual bench at 10 Hz."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.telemetry import SafeLevel, State
from tests.support.scenario import CheckedScenario, Outcome, play


def played(*at: dict[str, Any], duration_s: float = 60.0, **config: Any) -> Outcome:
    states = {"stay_after_trip": True, **config.pop("states", {})}
    config = {"loop": {"rate_hz": 10.0}, "states": states, **config}
    return play(
        CheckedScenario.model_validate(
            {"title": "states", "duration_s": duration_s, "config": config, "at": at, "expect": {}}
        )
    )


# 150 µm to inflate, and a ramp that waits
_FAR_BELOW: dict[str, Any] = {
    "duration_s": 200.0,
    "twin": {"start_error_um": -150.0, "scenario": "calm"},
    "states": {"inflate_pause_um": 5.0, "inflate_stall_s": 60.0},
    "limits": {"displacement_min_um": -400.0},
}


def changes(outcome: Outcome, state: str) -> list[float]:
    """Times at which a state was entered, s."""
    return [event["mono_s"] for event in outcome.of("state") if event["state"] == state]


def test_an_acknowledged_fault_ends_only_when_the_read_back_shows_the_pump_off() -> None:
    """The read-back says 0.5 from 22 s to 35 s."""
    outcome = played(
        {"time_s": 20.0, "wrong": "gauge_lost"},
        {"time_s": 22.0, "wrong": "readback_fraction", "value": 0.5, "for_s": 13.0},
        {"time_s": 25.0, "command": "ack"},
        states={"ramp_down_s": 1.0, "lower_timeout_s": 30.0},
    )
    (standby_s,) = changes(outcome, "standby")
    assert 35.0 <= standby_s < 35.3


def test_a_resume_waits_until_the_read_back_shows_the_pump_off() -> None:
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
            assert row.pump_fraction == pytest.approx(
                before * (1.0 - (row.mono_s - fault_s) / 10.0), abs=1e-6
            )


def test_a_pause_ends_after_its_longest_time() -> None:
    outcome = played({"time_s": 20.0, "command": "pause"}, states={"pause_max_s": 15.0})
    paused = [
        tick.row.mono_s
        for tick in outcome.ticks
        if tick.row.mono_s > 20.5 and tick.row.p_um_per_s == 0.0
    ]
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
def test_the_requests_of_a_hold_do_not_apply_to_the_next(
    wish: dict[str, Any], at: list[dict[str, Any]], config: dict[str, Any]
) -> None:
    outcome = played({"time_s": 20.0, **wish}, *at, **config)
    assert changes(outcome, "hold")[-1] > 30.0
    assert all(manual_s < 25.0 for manual_s in changes(outcome, "manual"))
    assert "paused" not in [event["why"] for event in outcome.of("why")][-1]


def test_hold_begins_after_settle_s_inside_the_band() -> None:
    outcome = played(states={"settle_s": 6.0}, duration_s=40.0)
    settle_s, hold_s = changes(outcome, "settle")[0], changes(outcome, "hold")[0]
    assert hold_s - settle_s >= 6.0
    errors_um = [
        tick.row.error_um for tick in outcome.ticks if hold_s - 6.0 < tick.row.mono_s < hold_s
    ]
    assert max(map(abs, errors_um)) < 2.0


def test_venting_continues_without_a_gauge() -> None:
    outcome = played(
        {"time_s": 20.0, "wrong": "gauge_lost"},
        {"time_s": 20.0, "command": "vent"},
        duration_s=40.0,
    )
    rows = [tick.row for tick in outcome.ticks if 21.0 < tick.row.mono_s < 40.0]
    assert {row.state for row in rows} == {State.LOWER}
    assert {row.vent_fraction for row in rows} == {1.0}


def test_a_vent_that_does_not_empty_the_mirror_is_reported() -> None:
    outcome = played(
        {"time_s": 20.0, "wrong": "gauge_lost"},
        {"time_s": 20.0, "command": "vent"},
        duration_s=950.0,
    )
    (reported,) = [event for event in outcome.of("why") if "check the vent" in event["why"]]
    assert 920.0 <= reported["mono_s"] < 930.0
    assert not changes(outcome, "standby")


def test_a_stop_cannot_be_undone() -> None:
    """A `lower` in the same tick does not turn the stop into standby."""
    outcome = played(
        {"time_s": 19.0, "wrong": "readback_fraction", "value": 0.5, "for_s": 2.5},
        {"time_s": 20.0, "command": "stop"},
        {"time_s": 20.0, "command": "lower"},
    )
    assert outcome.ticks[-1].outputs.finished is not None
    assert outcome.ticks[-1].row.mono_s < 24.0
    assert not changes(outcome, "standby")


def test_no_hold_begins_with_a_latched_board() -> None:
    """Its own limit is 800 Pa; here ours is higher, and the check has to see the board's bit."""
    outcome = played(
        {"time_s": 0.5, "wrong": "gauge_offset_pa", "value": 300.0, "for_s": 1.0},
        duration_s=20.0,
        limits={"gauge_pressure_max_pa": 2000.0},
    )
    assert not changes(outcome, "inflate")
    assert [event["name"] for event in outcome.of("fault")] == ["board_fault"]


def test_manual_ends_after_its_longest_time_and_the_loop_returns() -> None:
    outcome = played(
        {"time_s": 20.0, "command": "manual", "value": 1.2},
        {"time_s": 30.0, "command": "manual", "value": 1.1},
        states={"manual_max_s": 15.0, "manual_range_um": 1000.0},
    )
    assert [change for change in changes(outcome, "inflate") if change > 20.0] == [
        pytest.approx(45.1, abs=0.15)
    ]
    assert "no flow was set for 15 s" in next(
        e["why"] for e in outcome.of("state") if e["from"] == "manual"
    )
    assert len(changes(outcome, "hold")) == 2


@pytest.mark.parametrize("flow", [0.0, 5.3])
def test_manual_ends_where_the_mirror_strays_too_far(flow: float) -> None:
    outcome = played({"time_s": 20.0, "command": "manual", "value": flow}, duration_s=200.0)
    (manual_s,) = changes(outcome, "manual")
    back = next(e for e in outcome.of("state") if e["from"] == "manual")
    assert back["why"].startswith("manual is over: more than 50 µm")
    away_um = [
        abs(tick.row.truth_displacement_um) for tick in outcome.ticks if tick.row.mono_s > manual_s
    ]
    assert 45.0 < max(away_um) < 60.0
    assert State(outcome.ticks[-200].row.state) == State.HOLD


def test_manual_without_a_laser_gives_the_mean_flow_of_the_hold_before_it() -> None:
    outcome = played(
        {"time_s": 30.0, "command": "manual", "value": 5.3},
        {"time_s": 31.0, "wrong": "no_light", "for_s": 8.0},
        states={"hold_flow_max_s": 12.0},
    )
    rows = [tick.row for tick in outcome.ticks]
    held = [row.flow_um_per_s for row in rows if 25.0 < row.mono_s < 30.0]
    blind = [row.flow_um_per_s for row in rows if 31.7 < row.mono_s < 38.9]
    assert max(blind) - min(blind) < 0.1
    assert sum(blind) / len(blind) == pytest.approx(sum(held) / len(held), abs=0.3)
    assert State.HOLD in {row.state for row in rows if row.mono_s > 50.0}


def test_manual_is_refused_while_the_mean_flow_is_held() -> None:
    outcome = played(
        {"time_s": 20.0, "wrong": "no_light", "for_s": 5.0},
        {"time_s": 22.0, "command": "manual", "value": 5.3},
    )
    (refused,) = [event for event in outcome.of("command") if event["command"] == "manual"]
    assert "holds the mean flow" in refused["refused"]


def test_a_pause_ends_where_the_mirror_strays_too_far() -> None:
    """A leak of twice the size: on the old mean flow the mirror sinks by 1 µm/s."""
    outcome = played(
        {"time_s": 20.0, "command": "pause"},
        {"time_s": 21.0, "event": "leak", "value": 3.0},
        duration_s=200.0,
        limits={"following_error_max_um": 500.0},
    )
    deepest_um = min(tick.row.truth_displacement_um for tick in outcome.ticks[150:-50])
    assert -70.0 < deepest_um < -45.0
    assert "paused" not in [event["why"] for event in outcome.of("why")][-1]


def test_stopping_with_a_running_pump_is_not_a_success() -> None:
    """The pump stays at full flow and reports it; the vent opens, and the exit code shows it."""
    outcome = played(
        {"time_s": 20.0, "wrong": "pump_stuck_fraction", "value": 1.0},
        {"time_s": 20.0, "wrong": "readback_fraction", "value": 1.0},
        {"time_s": 20.5, "command": "stop"},
    )
    last = outcome.ticks[-1]
    assert outcome.ticks[-1].outputs.finished == Exit.SAFETY_TRIP
    assert last.row.mono_s < 40.0
    assert (last.outputs.command.pump_fraction, last.outputs.command.vent_fraction) == (0.0, 1.0)
    assert [(event["name"], "100 %" in event["seen"]) for event in outcome.of("fault")] == [
        ("pump_runs_on", True)
    ]


@pytest.mark.parametrize("lower_s", [0.0, 20.0])
@pytest.mark.parametrize("readback", [1.0, 0.0])
def test_a_pump_that_starts_by_itself_is_a_fault_in_standby(
    lower_s: float, readback: float
) -> None:
    """Whether its read-back shows it, or only the rising mirror."""
    outcome = played(
        {"time_s": lower_s, "command": "lower"},
        {"time_s": 60.0, "wrong": "pump_stuck_fraction", "value": 1.0},
        {"time_s": 60.0, "wrong": "readback_fraction", "value": readback},
        duration_s=150.0,
    )
    (fault,) = outcome.of("fault")
    assert fault["name"] == ("pump_runs_on" if readback else "gas_comes_in")
    assert fault["mono_s"] < (64.0 if readback else 90.0)
    assert max(tick.row.truth_displacement_um for tick in outcome.ticks) < 150.0
    assert outcome.ticks[-1].outputs.command.vent_fraction == 1.0
    assert State.STANDBY in {tick.row.state for tick in outcome.ticks if tick.row.mono_s > 59.0}


def test_a_pump_that_runs_on_in_a_fault_opens_the_vent() -> None:
    outcome = played(
        {"time_s": 20.0, "wrong": "pump_stuck_fraction", "value": 0.8},
        {"time_s": 20.0, "wrong": "readback_fraction", "value": 0.8},
        {"time_s": 21.0, "wrong": "gauge_lost"},
        states={"ramp_down_s": 1.0},
    )
    assert [event["name"] for event in outcome.of("fault")] == ["pressure_missing"]
    vents = [tick.row.mono_s for tick in outcome.ticks if tick.outputs.command.vent_fraction == 1.0]
    assert vents
    assert vents[0] < 32.0


def test_a_stop_waits_for_a_mirror_that_still_rises_and_ends_as_a_fault() -> None:
    """Read-back 0, but gas comes in."""
    outcome = played(
        {"time_s": 20.0, "wrong": "pump_stuck_fraction", "value": 1.0},
        {"time_s": 20.0, "wrong": "readback_fraction", "value": 0.0},
        {"time_s": 20.0, "command": "stop"},
        duration_s=100.0,
    )
    assert outcome.ticks[-1].outputs.finished == Exit.SAFETY_TRIP
    assert [event["name"] for event in outcome.of("fault")] == ["gas_comes_in"]


SAYS_HALF = {"wrong": "readback_fraction", "value": 0.5}  # the read-back, while it lasts


def test_lowering_ends_only_when_the_read_back_shows_the_pump_off() -> None:
    outcome = played(
        {"time_s": 20.0, "command": "lower"},
        {"time_s": 20.0, **SAYS_HALF, "for_s": 10.0},
        states={"lower_timeout_s": 30.0},
    )
    assert changes(outcome, "standby") == [pytest.approx(30.0, abs=0.3)]


@pytest.mark.parametrize("stop", [(), ({"time_s": 21.0, "command": "stop"},)])
def test_a_fault_ends_the_run_only_when_the_read_back_shows_the_pump_off(
    stop: tuple[dict[str, Any], ...],
) -> None:
    """Whether the run ends by itself after a trip or by a stop."""
    outcome = played(
        {"time_s": 20.0, "wrong": "unreachable", "for_s": 0.5},
        {"time_s": 20.5, **SAYS_HALF, "for_s": 20.0},
        *stop,
        states={"lower_timeout_s": 600.0, "stay_after_trip": False},
    )
    assert [event["name"] for event in outcome.of("fault")] == ["link_lost"]
    assert outcome.ticks[-1].outputs.finished == Exit.SAFETY_TRIP
    assert outcome.ticks[-1].row.mono_s == pytest.approx(
        40.6, abs=0.3
    )  # the mirror has rested long before


def test_stopping_without_a_connection_is_not_a_success() -> None:
    outcome = played({"time_s": 20.0, "command": "stop"}, {"time_s": 20.3, "wrong": "unreachable"})
    assert outcome.ticks[-1].outputs.finished == Exit.DEVICE_FAILED
    assert outcome.ticks[-1].row.mono_s == pytest.approx(23.3, abs=0.4)


def test_a_latch_between_a_resume_and_its_hold_cancels_the_hold() -> None:
    """In that one tick of standby the hold is already requested;
    a later `ack` revives no request.
    """
    lost = {"time_s": 20.0, "wrong": "unreachable", "for_s": 1.0}
    resume = {"faults": ["link_lost"], "wait_s": 5.0}
    (standby_s,) = changes(played(lost, duration_s=40.0, resume=resume), "standby")
    latch = {"time_s": standby_s - 0.01, "command": "latch"}
    outcome = played(lost, latch, {"time_s": standby_s + 3.0, "command": "ack"}, resume=resume)
    assert [event["refused"] for event in outcome.of("command") if "refused" in event] == []
    assert len(changes(outcome, "check")) == 1


def test_a_stop_wins_over_a_resume() -> None:
    outcome = played(
        {"time_s": 20.0, "wrong": "unreachable", "for_s": 1.0},
        {"time_s": 25.9, **SAYS_HALF, "for_s": 2.0},
        {"time_s": 26.0, "command": "stop"},
        resume={"faults": ["link_lost"], "wait_s": 5.0},
    )
    assert not changes(outcome, "standby")
    assert outcome.ticks[-1].outputs.finished == Exit.SAFETY_TRIP


def test_an_ack_clears_the_latches_of_the_board() -> None:
    outcome = played(
        {"time_s": 20.0, "wrong": "gauge_offset_pa", "value": 300.0, "for_s": 1.0},
        {"time_s": 25.0, "command": "ack"},
        {"time_s": 26.0, "command": "hold"},
        duration_s=40.0,
    )
    latched = [
        tick.inputs.reading.latched_faults
        for tick in outcome.ticks
        if tick.inputs.reading is not None
    ]
    assert max(latched) > 0
    assert latched[-1] == 0
    assert len(changes(outcome, "inflate")) == 2


@pytest.mark.parametrize("way", ["lower", "stop", "vent"])
def test_lowering_stops_the_pump_in_its_first_tick(way: str) -> None:
    outcome = played({"time_s": 25.0, "command": way}, duration_s=40.0)
    assert {tick.row.pump_fraction for tick in outcome.ticks if tick.row.mono_s > 25.05} == {0.0}


def test_readings_rejected_by_the_safety_table_do_not_drive_the_pump() -> None:
    outcome = played(
        {"time_s": 25.0, "wrong": "laser_stuck"}, limits={"stuck_s": 2.0}, duration_s=38.0
    )
    held = [tick.row for tick in outcome.ticks if tick.row.state == State.HOLD]
    distrusted = [row for row in held if row.safe_level == SafeLevel.HOLD_FLOW]
    assert len(distrusted) > 50
    assert {row.p_um_per_s for row in distrusted} == {0.0}


def test_an_inflation_that_takes_too_long_is_a_fault() -> None:
    outcome = played(
        {"time_s": 8.0, "wrong": "vent_stuck_fraction", "value": 0.1},
        states={"inflate_timeout_s": 20.0},
    )
    assert [event["name"] for event in outcome.of("fault")] == ["overdue"]


def test_after_an_acknowledged_fault_a_hold_needs_a_command() -> None:
    outcome = played(
        {"time_s": 20.0, "wrong": "gauge_lost", "for_s": 2.0},
        {"time_s": 30.0, "command": "ack"},
        states={"ramp_down_s": 1.0},
    )
    assert len(changes(outcome, "standby")) == 1
    assert len(changes(outcome, "check")) == 1


@pytest.mark.parametrize(
    "again", [(), ({"time_s": 32.0, "command": "ack"},)], ids=["once", "in standby as well"]
)
def test_an_ack_does_not_acknowledge_a_later_fault(
    again: tuple[dict[str, Any], ...],
) -> None:
    outcome = played(
        {"time_s": 20.0, "wrong": "gauge_lost", "for_s": 2.0},
        {"time_s": 30.0, "command": "ack"},
        *again,
        {"time_s": 33.0, "command": "hold"},
        {"time_s": 60.0, "wrong": "gauge_lost", "for_s": 2.0},
        duration_s=90.0,
        states={"ramp_down_s": 1.0},
    )
    assert len(changes(outcome, "fault")) == 2
    assert len(changes(outcome, "standby")) == 1


def test_the_ramp_waits_for_a_lagging_mirror() -> None:
    """A pump of 65 % lifts the mirror more slowly than the ramp; the setpoint stays within reach of
    the mirror.
    """
    outcome = played({"time_s": 0.0, "wrong": "pump_share", "value": 0.65}, **_FAR_BELOW)
    inflating = [tick.row for tick in outcome.ticks if tick.row.state == State.INFLATE]
    assert np.nanmax([row.error_um for row in inflating]) == pytest.approx(5.0, abs=1.0)
    assert any("the ramp waits" in event["why"] for event in outcome.of("why"))
    assert changes(outcome, "hold")


def test_the_ramp_does_not_wait_for_a_mirror_that_keeps_up() -> None:
    outcome = played(**_FAR_BELOW)
    assert not any("the ramp waits" in event["why"] for event in outcome.of("why"))
    assert changes(outcome, "hold")


@pytest.mark.parametrize(
    ("pump_share", "seen"),
    [
        pytest.param(0.0, "the mirror sank by", id="dead"),
        pytest.param(0.3, "no rise in 60 s", id="too weak for the leak"),
    ],
)
def test_a_mirror_that_does_not_rise_is_a_fault(pump_share: float, seen: str) -> None:
    outcome = played({"time_s": 15.0, "wrong": "pump_share", "value": pump_share}, **_FAR_BELOW)
    (reported,) = outcome.of("fault")
    assert reported["name"] == "overdue"
    assert seen in reported["seen"]
    assert reported["mono_s"] == pytest.approx(15.0 + 60.0, abs=10.0)


def test_a_mirror_above_its_setpoint_may_sink_as_slowly_as_it_leaks() -> None:
    outcome = played(
        duration_s=200.0, twin={"start_error_um": 150.0}, states={"inflate_stall_s": 20.0}
    )
    assert not outcome.of("fault")
    assert changes(outcome, "hold")[0] > 60.0
