"""The resume rule: listed faults only, after the whole wait, a limited number a day, never after a
vent.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from firmware_iface.register_map import load_default_map
from firmware_iface.roles import BenchReading
from membrane_ctrl.config.schema import (
    Config,
    LimitsConfig,
    LoopConfig,
    ResumeConfig,
    ShapeConfig,
    StatesConfig,
)
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.commands import AT_START
from membrane_ctrl.controller.observation import Observation
from membrane_ctrl.controller.resume_rule import ResumeRule
from membrane_ctrl.controller.safe_levels import SafeLevels
from membrane_ctrl.controller.safety import TABLE
from membrane_ctrl.hold.scenario_file import ScenarioStep
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.telemetry import SafeLevel, State
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.support.scenario import CheckedScenario, Expectation, play
from tests.worlds.quiet_observation import GOOD

RULES = {rule.name: rule for rule in TABLE}
LINK_LOST, LATE = RULES["link_lost"], RULES["late"]
CONFIG = ResumeConfig(faults=("link_lost",), wait_s=10.0, most_per_day=2)
WATCHDOG, OVER_PRESSURE = (
    load_default_map().make_fault_mask(name) for name in ("watchdog", "over_pressure")
)
SHUT = BenchReading(0.0, 0, 600.0, 101325.0, 23.0, 23.0, 0.0, 0.0, 1, 0.0, False, 0)
GONE = replace(GOOD, reading=SHUT)
LOST = replace(GONE, link_up=False)


class Fault:
    """A fault under the resume rule."""

    def __init__(
        self,
        name: str = "link_lost",
        config: ResumeConfig = CONFIG,
        safe_level: SafeLevel = SafeLevel.PUMP_OFF,
    ) -> None:
        self.rule = ResumeRule(config, LimitsConfig())
        self.fault, self.levels = RULES[name], SafeLevels(StatesConfig())
        self.levels.enter(safe_level, 0.0)

    def due(self, now_s: float, observation: Observation = GONE) -> bool:
        return self.rule.is_due(self.fault, self.levels, observation, now_s)


def test_only_listed_faults_may_resume() -> None:
    for name, possible in (("link_lost", True), ("late", False)):
        fault = Fault(name)
        fault.due(0.0)
        assert fault.rule.possible is possible


def test_a_fault_that_never_resumes_does_not_even_if_listed() -> None:
    config = ResumeConfig(faults=tuple(RULES), wait_s=10.0)
    never = {name for name, rule in RULES.items() if not rule.may_resume}
    assert {
        "over_pressure",
        "over_displacement",
        "board_fault",
        "pump_runs_on",
        "board_taken",
        "locked",
    } <= never
    for name in never:
        fault = Fault(name, config)
        fault.due(0.0)
        assert not fault.rule.possible, name


@pytest.mark.parametrize(
    "seen",
    [
        replace(GONE, board_faults=OVER_PRESSURE),
        replace(GONE, board_faults=OVER_PRESSURE | WATCHDOG),
        replace(GONE, board_faults=1 << 9),
        replace(GONE, reading=replace(SHUT, vent_fraction=1.0)),
        replace(GONE, locked="hands inside"),
        replace(GONE, foreign=1),
    ],
)
def test_one_observed_latch_or_open_vent_excludes_a_resume_for_the_whole_fault(
    seen: Observation,
) -> None:
    fault = Fault()
    fault.due(0.0, LOST)
    assert fault.rule.possible
    fault.due(1.0, seen)
    assert (fault.rule.possible, fault.rule.clear_mask) == (False, 0)
    assert not any(
        fault.due(2.0 + second) for second in range(60)
    )  # although nothing of it is visible any more
    assert not fault.rule.possible
    fault.rule.forget()
    fault.due(100.0)
    assert fault.rule.possible


def test_a_vented_fault_may_not_resume() -> None:
    fault = Fault(safe_level=SafeLevel.VENT)
    assert not any(fault.due(float(second)) for second in range(60))
    assert not fault.rule.possible


def test_only_the_watchdog_bit_is_cleared() -> None:
    fault = Fault()
    fault.due(0.0, LOST)
    fault.due(1.0, replace(GONE, board_faults=WATCHDOG))
    assert (fault.rule.possible, fault.rule.clear_mask) == (True, WATCHDOG)
    fault.due(2.0)
    assert fault.rule.clear_mask == 0


def test_the_cause_must_be_absent_for_the_whole_wait() -> None:
    fault = Fault()
    assert not fault.due(1000.0)  # the cause was not seen to go: the wait begins now
    assert not fault.due(1001.0, LOST)
    assert [fault.due(now_s) for now_s in (1002.0, 1011.0)] == [False, False]
    assert not fault.due(1011.5, LOST)
    assert [fault.due(now_s) for now_s in (1012.0, 1021.9, 1022.0)] == [False, False, True]


def test_the_daily_number_of_resumes_is_limited_and_restored_after_a_day() -> None:
    fault = Fault()
    fault.rule.resumed(-50_000.0)  # of an earlier run
    fault.rule.resumed(10.0)
    for now_s, possible in ((20.0, False), (36_399.0, False), (36_401.0, True)):
        fault.due(now_s)
        assert fault.rule.possible is possible, now_s


def scenario(*at: ScenarioStep, duration_s: float, faults: tuple[str, ...]) -> CheckedScenario:
    return CheckedScenario.model_validate(
        {
            "title": "resume",
            "duration_s": duration_s,
            "config": {"loop": {"rate_hz": 10.0}, "resume": {"faults": faults, "wait_s": 10.0}},
            "at": at,
            "expect": Expectation(),
        }
    )


@pytest.mark.parametrize("wrong", ["unreachable", "silent"])
def test_a_cause_that_returns_restarts_the_wait(wrong: str) -> None:
    """Gone at 22 s, back from 24 s to 40 s: nothing may resume before 50 s."""
    steps = (
        ScenarioStep(time_s=20.0, wrong=wrong, for_s=2.0),
        ScenarioStep(time_s=24.0, wrong=wrong, for_s=16.0),
    )
    outcome = play(scenario(*steps, duration_s=55.0, faults=("link_lost", "device_silent")))
    resumed = [event["mono_s"] for event in outcome.of("state") if event["from"] == "fault"]
    assert len(resumed) == 1
    assert 50.0 <= resumed[0] < 52.0


@pytest.mark.parametrize(
    ("wrong", "fault"), [("no_light", "displacement_missing"), ("gauge_lost", "pressure_missing")]
)
def test_a_lasting_cause_is_waited_for(wrong: str, fault: str) -> None:
    """The link is there all the time, the sensor comes back at 100 s: nothing may resume before 110
    s.
    """
    outcome = play(
        scenario(
            ScenarioStep(time_s=20.0, wrong=wrong, for_s=80.0), duration_s=115.0, faults=(fault,)
        )
    )
    assert [event["name"] for event in outcome.of("fault")] == [fault]
    resumed = [event["mono_s"] for event in outcome.of("state") if event["from"] == "fault"]
    assert len(resumed) == 1
    assert 110.0 <= resumed[0] < 112.0


def test_the_wait_starts_at_zero_for_the_next_fault() -> None:
    """Acknowledged after 8 s of the wait; the next fault waits its own 10 s."""
    steps = (
        ScenarioStep(time_s=20.0, wrong="stalled", for_s=1.0),
        ScenarioStep(time_s=29.0, command="ack"),
        ScenarioStep(time_s=29.5, command="hold"),
        ScenarioStep(time_s=45.0, wrong="stalled", for_s=1.0),
    )
    outcome = play(scenario(*steps, duration_s=60.0, faults=("watchdog_tripped",)))
    left = [event["mono_s"] for event in outcome.of("state") if event["from"] == "fault"]
    assert len(outcome.of("fault")) == len(left) == 2
    assert left[1] >= 56.0


def test_an_intermittent_link_does_not_prevent_a_resume() -> None:
    steps = (
        ScenarioStep(time_s=20.0, wrong="unreachable", for_s=2.0),
        ScenarioStep(time_s=22.5, wrong="lost_every", value=7),
    )
    outcome = play(scenario(*steps, duration_s=40.0, faults=("link_lost",)))
    left = [event["mono_s"] for event in outcome.of("state") if event["from"] == "fault"]
    assert len(left) == 1
    assert left[0] < 34.0


def test_a_board_that_has_vented_while_the_link_was_down_stays_down() -> None:
    """Its own limit trips at 800 Pa during the outage; afterwards gauge, link and vent are as they
    should be.
    """
    steps = (
        ScenarioStep(time_s=20.0, wrong="unreachable", for_s=5.0),
        ScenarioStep(time_s=21.0, wrong="gauge_offset_pa", value=300.0, for_s=2.0),
    )
    outcome = play(scenario(*steps, duration_s=60.0, faults=("link_lost",)))
    assert [event["name"] for event in outcome.of("fault")] == ["link_lost"]
    assert not [event for event in outcome.of("state") if event["from"] == "fault"]
    last = outcome.ticks[-1]
    assert last.inputs.reading is not None
    assert last.inputs.reading.latched_faults == OVER_PRESSURE | WATCHDOG
    assert (last.row.vent_readback_fraction, last.row.pump_readback_fraction) == (1.0, 0.0)


def test_a_resume_is_reported_and_limited_by_the_daily_number() -> None:
    steps = tuple(
        ScenarioStep(time_s=20.0 + 40.0 * k, wrong="unreachable", for_s=2.0) for k in range(4)
    )
    outcome = play(scenario(*steps, duration_s=180.0, faults=("link_lost",)))
    assert [event["name"] for event in outcome.of("resumed")] == ["link_lost"] * 3
    assert {tick.outputs.clear_mask for tick in outcome.ticks} == {0, WATCHDOG}
    assert State(outcome.ticks[-1].row.state) == State.FAULT


@pytest.mark.parametrize(("who", "possible"), [(AT_START, False), ("unix:ann", True)])
def test_only_the_start_of_a_run_reports_earlier_resumes(who: str, possible: bool) -> None:
    config = Config(
        loop=LoopConfig(rate_hz=10.0),
        shape=ShapeConfig(enabled=False),
        resume=ResumeConfig(faults=("link_lost",), wait_s=5.0, most_per_day=2),
    )
    bench = VirtualBench(Plant(config.twin, config.pump))
    run = VirtualRun(config, bench, zernike_projection())
    run.run_tick(
        (
            Command("resumed", who, value=7200.0),
            Command("resumed", who, value=60.0),
            Command("hold", "ann"),
        )
    )
    resumed = 0
    for tick in range(400):
        bench.wrong.unreachable = 200 <= tick < 210
        made = run.run_tick()
        resumed += sum(event.kind == "resumed" for event in made.events) if made else 0
    assert resumed == possible
    assert (run.finished is None) == possible
