"""The resume rule: only what is listed, only after the whole wait, only so often a day; never what has vented."""

from __future__ import annotations

import pytest

from membrane_ctrl.config import ResumeConfig
from membrane_ctrl.names import Rung
from membrane_ctrl.resume import ResumeRule
from membrane_ctrl.safety import TABLE
from membrane_ctrl.virtual.scenario import At, Expectation, Scenario, play

LINK_LOST = next(rule for rule in TABLE if rule.name == "link_lost")
LATE = next(rule for rule in TABLE if rule.name == "late")
CONFIG = ResumeConfig(faults=("link_lost",), wait_s=10.0, most_per_day=2)


def test_only_what_is_listed_and_not_vented_is_possible() -> None:
    rule = ResumeRule(CONFIG)
    assert rule.possible(LINK_LOST, Rung.PUMP_OFF, 0.0)
    assert not rule.possible(LATE, Rung.PUMP_OFF, 0.0)
    assert not rule.possible(LINK_LOST, Rung.VENT, 0.0)


def test_the_cause_must_stay_away_for_the_whole_wait() -> None:
    rule = ResumeRule(CONFIG)
    assert not rule.due(True, 1000.0)  # nobody has seen the cause go: the wait begins now
    assert not rule.due(False, 1001.0)
    assert [rule.due(True, now_s) for now_s in (0.0, 9.0)] == [False, False]
    assert not rule.due(False, 9.5)
    assert [rule.due(True, now_s) for now_s in (10.0, 19.9, 20.0)] == [False, False, True]
    assert not rule.due(True, 20.1)


def test_the_days_number_is_used_up_and_comes_back_a_day_after() -> None:
    rule = ResumeRule(CONFIG)
    for begin_s in (0.0, 100.0):
        rule.due(True, begin_s)
        assert rule.due(True, begin_s + 10.0)
    assert not rule.possible(LINK_LOST, Rung.PUMP_OFF, 86_400.0 + 9.0)
    assert rule.possible(LINK_LOST, Rung.PUMP_OFF, 86_400.0 + 11.0)


def scenario(*at: At, duration_s: float, faults: tuple[str, ...]) -> Scenario:
    return Scenario.model_validate(
        {
            "title": "resume",
            "duration_s": duration_s,
            "config": {"loop": {"rate_hz": 10.0}, "resume": {"faults": faults, "wait_s": 10.0}},
            "at": at,
            "expect": Expectation(),
        }
    )


@pytest.mark.parametrize("wrong", ["unreachable", "silent"])
def test_a_cause_that_comes_back_during_the_wait_is_waited_for_from_its_end(wrong: str) -> None:
    """Gone at 22 s, back from 24 s to 40 s: nothing may resume before 50 s."""
    steps = (At(time_s=20.0, wrong=wrong, for_s=2.0), At(time_s=24.0, wrong=wrong, for_s=16.0))
    outcome = play(scenario(*steps, duration_s=55.0, faults=("link_lost", "device_silent")))
    resumed = [event["mono_s"] for event in outcome.of("state") if event["from"] == "fault"]
    assert len(resumed) == 1
    assert 50.0 <= resumed[0] < 52.0


@pytest.mark.parametrize(
    ("wrong", "fault"), [("no_light", "displacement_missing"), ("gauge_lost", "pressure_missing")]
)
def test_a_cause_that_stays_is_waited_out(wrong: str, fault: str) -> None:
    """The link is there all the time, the sensor comes back at 100 s: nothing may resume before 110 s."""
    outcome = play(scenario(At(time_s=20.0, wrong=wrong, for_s=80.0), duration_s=115.0, faults=(fault,)))
    assert [event["name"] for event in outcome.of("fault")] == [fault]
    resumed = [event["mono_s"] for event in outcome.of("state") if event["from"] == "fault"]
    assert len(resumed) == 1
    assert 110.0 <= resumed[0] < 112.0


def test_a_wait_does_not_count_in_the_next_fault() -> None:
    """Acknowledged after 8 s of the wait; the next fault waits its own 10 s."""
    steps = (
        At(time_s=20.0, wrong="stalled", for_s=1.0),
        At(time_s=29.0, command="ack"),
        At(time_s=29.5, command="hold"),
        At(time_s=45.0, wrong="stalled", for_s=1.0),
    )
    outcome = play(scenario(*steps, duration_s=60.0, faults=("watchdog_tripped",)))
    left = [event["mono_s"] for event in outcome.of("state") if event["from"] == "fault"]
    assert len(outcome.of("fault")) == len(left) == 2
    assert left[1] >= 56.0


def test_a_flaky_link_does_not_keep_the_mirror_down() -> None:
    steps = (At(time_s=20.0, wrong="unreachable", for_s=2.0), At(time_s=22.5, wrong="lost_every", value=7))
    outcome = play(scenario(*steps, duration_s=40.0, faults=("link_lost",)))
    left = [event["mono_s"] for event in outcome.of("state") if event["from"] == "fault"]
    assert len(left) == 1
    assert left[0] < 34.0
