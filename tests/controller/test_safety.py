"""Every row of the safety table: at N - 1 of M ticks it does not trip, at N it does."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from firmware_iface.roles import FOREIGN_CLAIM, FOREIGN_PERIOD
from membrane_ctrl.config.schema import LimitsConfig
from membrane_ctrl.controller.link_report import LinkReport
from membrane_ctrl.controller.safety import TABLE, SafetyTable
from membrane_ctrl.controller.safety_rule import Rule
from membrane_ctrl.model.telemetry import SafeLevel, State
from tests.worlds.quiet_observation import GOOD

LIMITS = LimitsConfig()
BAD = {
    "over_pressure": replace(GOOD, gauge_pressure_pa=LIMITS.gauge_pressure_max_pa + 0.1),
    "over_displacement": replace(GOOD, displacement_um=LIMITS.displacement_max_um + 0.1),
    "under_displacement": replace(GOOD, displacement_um=LIMITS.displacement_min_um - 0.1),
    "tick_error": replace(GOOD, tick_error="ValueError: x"),
    "dead_task": replace(GOOD, dead_tasks=("socket",)),
    "link_lost": replace(GOOD, link_up=False),
    "device_silent": replace(GOOD, reading_age_s=LIMITS.stale_s + 0.01),
    "watchdog_tripped": replace(GOOD, watchdog_tripped=True),
    "board_fault": replace(GOOD, board_faults=4),
    "pump_mismatch": replace(GOOD, pump_mismatch=0.2),
    "displacement_frozen": replace(GOOD, advance_age_s=LIMITS.stale_s + 0.01),
    "film_unseen": replace(GOOD, unseen_film="no figure of the mirror for 0.6 s"),
    "laser_implausible": replace(GOOD, laser_fault_text="laser +30 µm, camera 0 µm, gauge 0 µm"),
    "displacement_stuck": replace(GOOD, same_s=LIMITS.stuck_s + 0.01),
    "laser_gauge_apart": replace(GOOD, laser_gauge_apart="laser +0 µm, gauge +40 µm"),
    "gauge_stuck": replace(GOOD, gauge_same_s=LIMITS.gauge_stuck_s + 0.01),
    "gas_excess": replace(GOOD, gas_excess="3.2 µm/s, before 1.2 µm/s"),
    "gauge_jump": replace(GOOD, gauge_jumps=1),
    "displacement_jump": replace(GOOD, jumps=1),
    "displacement_missing": replace(GOOD, displacement_valid=False),
    "no_answer": replace(GOOD, displacement_valid=False, answered=False),
    "pressure_missing": replace(GOOD, gauge_pressure_pa=math.nan),
    "following_error": replace(GOOD, error_um=-LIMITS.following_error_max_um - 0.1),
    "overdue": replace(GOOD, overdue="waited too long"),
    "actuator_test": replace(GOOD, unfit="the vent does nothing"),
    "pump_runs_on": replace(GOOD, runs_on="read-back 100 %"),
    "gas_comes_in": replace(GOOD, inflow="+40 µm in 20 s"),
    "board_taken": replace(GOOD, foreign=FOREIGN_PERIOD),
    "interlock_open": replace(
        GOOD, open_interlocks=1, interlock_level=SafeLevel.PUMP_OFF, interlock_words="door"
    ),
    "locked": replace(GOOD, locked="hands inside"),
    "late": replace(GOOD, lateness_ms=LIMITS.lateness_max_ms + 1),
    "link_slow": replace(GOOD, lateness_ms=LIMITS.lateness_max_ms + 1, link=LinkReport(50.0)),
    "watchdog_by_link": replace(
        GOOD, watchdog_tripped=True, link=LinkReport(LIMITS.lateness_max_ms + 1)
    ),
}


# A rule that names the link as the cause, and the one that it stands before
BY_LINK = {"no_answer": "displacement_missing", "link_slow": "late"} | {
    "watchdog_by_link": "watchdog_tripped"
}


def judge_alone(rule: Rule) -> SafetyTable:
    return SafetyTable(LIMITS, (rule,))


def test_every_rule_has_a_case_here() -> None:
    assert {rule.name for rule in TABLE} == set(BAD)


@pytest.mark.parametrize("name", BY_LINK)
def test_a_links_fault_comes_first_and_is_as_safe(name: str) -> None:
    """Same level and window in the same states, so that only the cause differs."""
    rules = {rule.name: rule for rule in TABLE}
    link, other = rules[name], rules[BY_LINK[name]]
    assert (link.safe_level, link.seen_in, link.states) == (
        other.safe_level,
        other.seen_in,
        other.states,
    )
    table = SafetyTable(LIMITS)
    for _ in range(link.needed_ticks):
        tripped = table.judge(State.HOLD, BAD[name]).rule
    assert tripped is link
    table = SafetyTable(LIMITS)
    for _ in range(link.needed_ticks):
        tripped = table.judge(State.HOLD, BAD[other.name]).rule
    assert tripped is other


def test_a_late_tick_that_the_link_explains_only_in_part_is_late() -> None:
    table = SafetyTable(LIMITS)
    lateness_ms = 3 * LIMITS.lateness_max_ms
    late = replace(GOOD, lateness_ms=lateness_ms, link=LinkReport(0.5 * lateness_ms))
    for _ in range(5):
        tripped = table.judge(State.HOLD, late).rule
    assert tripped is not None
    assert tripped.name == "late"
    assert "150 ms of waiting" in tripped.seen(late)


def test_codes_and_names_are_unique() -> None:
    assert len({rule.code for rule in TABLE}) == len({rule.name for rule in TABLE}) == len(TABLE)


@pytest.mark.parametrize("state", State)
def test_a_normal_observation_trips_no_rule(state: State) -> None:
    table = SafetyTable(LIMITS)
    for _ in range(200):
        assert table.judge(state, GOOD).rule is None


@pytest.mark.parametrize("rule", TABLE, ids=lambda rule: rule.name)
def test_a_rule_trips_at_exactly_the_needed_number_of_ticks(rule: Rule) -> None:
    table = judge_alone(rule)
    state = State.HOLD if State.HOLD in rule.states else next(iter(rule.states))
    for _ in range(rule.needed_ticks - 1):
        assert table.judge(state, BAD[rule.name]).rule is None
    verdict = table.judge(state, BAD[rule.name])
    assert verdict.rule is rule


@pytest.mark.parametrize(
    "rule", [r for r in TABLE if r.needed_ticks > 1], ids=lambda rule: rule.name
)
def test_bad_ticks_outside_one_window_do_not_trip(rule: Rule) -> None:
    table = judge_alone(rule)
    for _ in range(3 * rule.needed_ticks):
        assert table.judge(State.HOLD, BAD[rule.name]).rule is None
        for _ in range(rule.window):
            assert table.judge(State.HOLD, GOOD).rule is None


@pytest.mark.parametrize("rule", TABLE, ids=lambda rule: rule.name)
def test_a_state_where_a_rule_does_not_apply_forgets_its_history(rule: Rule) -> None:
    elsewhere = next((s for s in State if s not in rule.states), None)
    if elsewhere is None:
        assert rule.safe_level == SafeLevel.VENT  # only venting rules apply in every state
        return
    table = judge_alone(rule)
    for _ in range(rule.window * 2):
        assert table.judge(elsewhere, BAD[rule.name]).rule is None


def test_the_first_row_of_the_table_wins() -> None:
    table = SafetyTable(LIMITS)
    both = replace(BAD["link_lost"], gauge_pressure_pa=2000.0)
    table.judge(State.HOLD, both)
    rule = table.judge(State.HOLD, both).rule
    assert rule is not None
    assert rule.name == "over_pressure"


def test_nan_is_never_accepted_as_safe() -> None:
    table = SafetyTable(LIMITS)
    lost = replace(GOOD, displacement_um=math.nan, displacement_valid=False)
    rules = [table.judge(State.HOLD, lost).rule for _ in range(3)]
    assert rules[-1] is not None
    assert rules[-1].safe_level == SafeLevel.HOLD_FLOW


def test_the_sentence_for_the_operator_contains_the_value() -> None:
    table = SafetyTable(LIMITS)
    table.judge(State.HOLD, BAD["over_pressure"])
    assert table.judge(State.HOLD, BAD["over_pressure"]).seen == "750.1 Pa"


@pytest.mark.parametrize("state", [state for state in State if state != State.FAULT])
@pytest.mark.parametrize(
    ("foreign", "seen"),
    [
        (FOREIGN_CLAIM, "another claim is active"),
        (FOREIGN_PERIOD, "another watchdog period is active"),
        (
            FOREIGN_CLAIM | FOREIGN_PERIOD,
            "another claim is active and another watchdog period is active",
        ),
    ],
)
def test_changed_board_settings_are_a_fault_in_the_same_tick(
    state: State, foreign: int, seen: str
) -> None:
    verdict = SafetyTable(LIMITS).judge(state, replace(GOOD, foreign=foreign))
    assert verdict.rule is not None
    assert (verdict.rule.name, verdict.rule.may_resume, verdict.seen) == (
        "board_taken",
        False,
        seen,
    )


UNSEEN = {
    "over_pressure": replace(GOOD, gauge_pressure_pa=math.nan),
    "over_displacement": replace(GOOD, displacement_um=math.nan, displacement_valid=False),
    "under_displacement": replace(GOOD, displacement_um=math.nan, displacement_valid=False),
    "following_error": replace(GOOD, error_um=math.nan),
    "pressure_missing": replace(GOOD, gauge_pressure_pa=math.nan, reading_age_s=0.02),
}


@pytest.mark.parametrize("name", UNSEEN)
def test_ticks_without_an_observation_are_left_out_of_the_window(name: str) -> None:
    rule = next(rule for rule in TABLE if rule.name == name)
    table = judge_alone(rule)
    for _ in range(rule.needed_ticks - 1):
        assert table.judge(State.HOLD, BAD[name]).rule is None
        for _ in range(rule.window):
            assert table.judge(State.HOLD, UNSEEN[name]).rule is None
    assert table.judge(State.HOLD, BAD[name]).rule is rule


def test_entering_another_state_clears_the_history_of_a_rule() -> None:
    table = SafetyTable(LIMITS)
    rule = next(rule for rule in TABLE if rule.name == "following_error")
    for _ in range(rule.needed_ticks - 1):
        table.judge(State.HOLD, BAD[rule.name])
    table.judge(State.STANDBY, GOOD)
    assert table.judge(State.HOLD, BAD[rule.name]).rule is None


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("name", ["over_pressure", "over_displacement"])
def test_the_hard_limits_open_the_vent_in_every_state(name: str, state: State) -> None:
    table = SafetyTable(LIMITS)
    table.judge(state, BAD[name])
    rule = table.judge(state, BAD[name]).rule
    assert rule is not None
    assert (rule.name, rule.safe_level) == (name, SafeLevel.VENT)


@pytest.mark.parametrize(
    ("name", "optics_um"),
    [
        ("over_displacement", LIMITS.displacement_max_um + 0.1),
        ("under_displacement", LIMITS.displacement_min_um - 0.1),
    ],
)
def test_each_displacement_limit_judges_the_sensor_that_is_nearest_to_it(
    name: str, optics_um: float
) -> None:
    rule = next(rule for rule in TABLE if rule.name == name)
    beside_a_laser = replace(GOOD, optics_guard_um=optics_um)
    assert rule.broken(beside_a_laser, LIMITS)
    assert rule.seen(beside_a_laser) == f"{optics_um:.1f} µm"
    assert rule.broken(replace(BAD[name], optics_guard_um=0.0), LIMITS)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_following_error_is_judged_in_both_directions(side: float) -> None:
    table = SafetyTable(LIMITS)
    far = replace(GOOD, error_um=side * (LIMITS.following_error_max_um + 0.1))
    assert any(table.judge(State.HOLD, far).rule is not None for _ in range(100))


@pytest.mark.parametrize("level", [SafeLevel.RAMP_DOWN, SafeLevel.PUMP_OFF, SafeLevel.VENT])
@pytest.mark.parametrize("state", [state for state in State if state != State.STANDBY])
def test_an_open_interlock_enters_its_own_level_in_one_tick(state: State, level: SafeLevel) -> None:
    verdict = SafetyTable(LIMITS).judge(
        state, replace(BAD["interlock_open"], interlock_level=level)
    )
    assert verdict.rule is not None
    assert (verdict.rule.name, verdict.safe_level, verdict.seen) == (
        "interlock_open",
        level,
        "door",
    )
    assert verdict.rule.fault(verdict.seen, verdict.safe_level).safe_level == level.name.lower()


def test_an_open_interlock_without_a_known_level_ramps_the_pump_down() -> None:
    verdict = SafetyTable(LIMITS).judge(
        State.HOLD, replace(BAD["interlock_open"], interlock_level=SafeLevel.NONE)
    )
    assert verdict.safe_level == SafeLevel.RAMP_DOWN


@pytest.mark.parametrize(
    ("level", "name"), [(SafeLevel.RAMP_DOWN, "link_lost"), (SafeLevel.VENT, "interlock_open")]
)
def test_of_rules_that_trip_together_the_level_of_this_observation_decides(
    level: SafeLevel, name: str
) -> None:
    both = replace(BAD["link_lost"], open_interlocks=1, interlock_level=level)
    rule = SafetyTable(LIMITS).judge(State.HOLD, both).rule
    assert rule is not None
    assert rule.name == name
