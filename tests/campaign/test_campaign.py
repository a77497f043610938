"""A part of the fault campaign in every test run; `make campaign` runs all of it."""

from __future__ import annotations

from pathlib import Path

import pytest
from campaign import DOCUMENT, SEEDS, STORIES, document, run_all, run_story
from campaign_cases import CASES, SITUATIONS, Case, Situation
from campaign_holds import HOLDS
from campaign_run import run_case

from membrane_ctrl.controller.observation import Observation
from membrane_ctrl.controller.safe_levels import SafeLevels
from membrane_ctrl.controller.safety import TABLE, SafetyTable, Verdict
from membrane_ctrl.model.telemetry import SafeLevel, State


def case_called(name: str) -> Case:
    return next(case for case in CASES if case.name == name)


def at(name: str) -> Situation:
    return next(situation for situation in SITUATIONS if situation.name == name)


# These take more than a second each.
LONG = {
    "a_creeping_laser",
    "a_creeping_laser_without_a_camera",
    "a_pump_that_gives_no_answer",
    "a_pump_that_hears_nothing",
    "a_seam_that_opens",
    "an_open_interlock_in_every_state",
    "dead_actuators_are_found",
    "manual_has_an_end",
    "optics_that_creep_without_a_laser",
    "resumes_of_a_day",
    "the_board_alone_keeps_its_limit",
    "the_supervisor_hangs",
    "two_orders_in_one_tick",
    "vent_and_stop_from_everywhere",
    "venting_to_the_end",
}
NAMES = [story.__name__ for story in (*STORIES, *HOLDS)]


@pytest.mark.parametrize(
    "number", range(len(CASES)), ids=[case.name.replace(" ", "_") for case in CASES]
)
def test_every_fault_in_one_situation(number: int) -> None:
    """Every other fault in `hold`; the rest in each situation in turn."""
    situation = SITUATIONS[number // 2 % len(SITUATIONS)] if number % 2 else at("hold")
    assert not run_case(CASES[number], situation, seed=12).violations


@pytest.mark.parametrize("name", [name for name in NAMES if name not in LONG])
def test_every_short_story(name: str) -> None:
    assert not run_story(name).violations


def test_equal_seeds_give_equal_runs() -> None:
    case = case_called("network comes and goes")
    assert run_case(case, at("hold"), 5) == run_case(case, at("hold"), 5)


def test_the_watch_detects_a_blind_safety_table(monkeypatch: pytest.MonkeyPatch) -> None:
    def blind(self: SafetyTable, state: State, observation: Observation) -> Verdict:
        return Verdict(None)

    monkeypatch.setattr(SafetyTable, "judge", blind)
    for name in ("no answers", "gauge lost", "pump runs at full", "task dead", "ticks 150 ms late"):
        assert run_case(case_called(name), at("hold"), 1).violations, name


def test_the_watch_detects_safe_levels_that_stay_on_the_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def stay(self: SafeLevels, safe_level: SafeLevel, now_s: float) -> None:
        self.memory.safe_level = SafeLevel.HOLD_FLOW

    monkeypatch.setattr(SafeLevels, "enter", stay)
    for name in ("network cut", "gauge lost", "pump runs at full"):
        assert run_case(case_called(name), at("hold"), 1).violations, name


def test_the_watch_detects_a_board_without_a_watchdog(monkeypatch: pytest.MonkeyPatch) -> None:
    from firmware_iface.emulators.pump_board import BoardState

    monkeypatch.setattr(BoardState, "_latch_fault", lambda self, mask: None)
    assert run_case(case_called("process stopped for ever"), at("hold"), 1).violations


def test_the_committed_matrix_is_of_these_faults_stories_and_rules() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    lines = text.partition("## With real processes")[0].splitlines()
    runs, stories = len(CASES) * len(SITUATIONS) * len(SEEDS), (*STORIES, *HOLDS)
    assert f"**{runs} runs and {len(stories)} stories, 0 violations of an invariant.**" in lines
    firsts = [line.split(" | ")[0].removeprefix("| ") for line in lines]
    assert "| fault | " + " | ".join(at.name for at in SITUATIONS) + " |" in lines
    for name in [
        *(case.name for case in CASES),
        *(story.__name__.replace("_", " ") for story in stories),
    ]:
        assert firsts.count(name) == 1, name
    for rule in TABLE:
        assert firsts.count(f"{rule.code} `{rule.name}`") == 1, rule.name
    assert "**nowhere**" not in text
    assert "bad**" not in text


@pytest.mark.campaign
@pytest.mark.timeout(1800)
def test_the_whole_campaign(tmp_path: Path) -> None:
    results, story_results = run_all(processes=2)
    assert len(results) >= 1000
    DOCUMENT.write_text(document(results, story_results), encoding="utf-8")
    assert not [violation for found in (*results, *story_results) for violation in found.violations]
