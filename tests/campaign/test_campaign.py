"""A part of the fault campaign with every run of the tests; the whole by `make campaign`."""

from __future__ import annotations

from pathlib import Path

import pytest
from campaign import DOCUMENT, SEEDS, document, run_all
from campaign_cases import CASES, STATES, Case
from campaign_run import run_case

from membrane_ctrl.ladder import Ladder
from membrane_ctrl.names import Rung, State
from membrane_ctrl.safety import Observation, SafetyTable, Verdict

SUBSET = (State.CHECK, State.INFLATE, State.HOLD, State.FAULT)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name.replace(" ", "_"))
def test_every_fault_in_four_states(case: Case) -> None:
    found = [run_case(case, state, seed=11) for state in SUBSET]
    assert not [violation for result in found for violation in result.violations]


def test_equal_seeds_give_equal_runs() -> None:
    case = next(case for case in CASES if case.name == "network comes and goes")
    assert run_case(case, State.HOLD, 5) == run_case(case, State.HOLD, 5)


def case_called(name: str) -> Case:
    return next(case for case in CASES if case.name == name)


def test_the_watch_sees_a_blind_safety_table(monkeypatch: pytest.MonkeyPatch) -> None:
    def blind(self: SafetyTable, state: State, observation: Observation) -> Verdict:
        return Verdict(None)

    monkeypatch.setattr(SafetyTable, "judge", blind)
    for name in ("no answers", "gauge lost", "pump runs at full", "task dead", "ticks 150 ms late"):
        assert run_case(case_called(name), State.HOLD, 1).violations, name


def test_the_watch_sees_a_ladder_that_stays_on_its_first_rung(monkeypatch: pytest.MonkeyPatch) -> None:
    def stay(self: Ladder, rung: Rung, now_s: float) -> None:
        self.rung = Rung.HOLD_FLOW

    monkeypatch.setattr(Ladder, "enter", stay)
    for name in ("network cut", "gauge lost", "pump runs at full"):
        assert run_case(case_called(name), State.HOLD, 1).violations, name


def test_the_watch_sees_a_board_without_a_watchdog(monkeypatch: pytest.MonkeyPatch) -> None:
    from firmware_iface.emulators.board_state import BoardState

    monkeypatch.setattr(BoardState, "_latch", lambda self, mask: None)
    assert run_case(case_called("process stopped for ever"), State.HOLD, 1).violations


def test_the_committed_matrix_is_of_these_faults() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    assert f"**{len(CASES) * len(STATES) * len(SEEDS)} runs, 0 violations" in text
    assert all(f"| {case.name} |" in text for case in CASES)


@pytest.mark.campaign
@pytest.mark.timeout(1800)
def test_the_whole_campaign(tmp_path: Path) -> None:
    results = run_all(processes=2)
    assert len(results) >= 1000
    DOCUMENT.write_text(document(results), encoding="utf-8")
    assert not [violation for result in results for violation in result.violations]
