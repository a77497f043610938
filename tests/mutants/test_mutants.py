"""The list of mutants matches the present code."""

from __future__ import annotations

from collections import Counter

import mutants
import pytest
from mutants import (
    CAMPAIGN_GOAL,
    DOCUMENT,
    ROOT,
    SAFETY,
    TESTS_GOAL,
    count_kills,
    current_verdicts,
    document,
    load,
    removes,
)

from membrane_ctrl.controller.safety import TABLE


def test_every_mutation_applies_exactly_once_and_is_python(monkeypatch: pytest.MonkeyPatch) -> None:
    sources = list(mutants._sources(ROOT))
    monkeypatch.setattr(mutants, "_sources", lambda _: sources)  # not read again for each
    for mutant in load()[0]:
        text = mutant.place(ROOT).read_text(encoding="utf-8")
        assert mutant.applied(text) != text, mutant.what


def test_each_rule_of_the_safety_table_is_made_to_never_trip() -> None:
    made = [mutant for mutant in load()[0] if mutant.rule]
    assert [(mutant.rule, mutant.what) for mutant in made] == [
        (r.name, f"{r.name} never trips") for r in TABLE
    ]
    for mutant in made:
        assert removes(mutant) == mutant.rule
        scope: dict[str, object] = {}
        exec(mutant.applied(SAFETY.read_text(encoding="utf-8")), scope)
        mutated = {rule.name: rule for rule in scope["TABLE"]}  # type: ignore[attr-defined]
        assert not mutated[mutant.rule].broken(None, None)


def test_mutants_are_enough_and_have_unique_names() -> None:
    mutants = load()[0]
    assert len(mutants) >= 80
    assert max(Counter(mutant.what for mutant in mutants).values()) == 1


def test_every_area_has_mutations_and_first_tests() -> None:
    mutants, firsts = load()
    assert {mutant.area for mutant in mutants} == firsts.keys()
    assert all(first.tests for first in firsts.values())
    assert {first.campaign for first in firsts.values()} <= {
        "holds",
        "board",
        "interlocks",
        "orders",
        "matrix",
        "sensors",
    }


def test_the_fast_tests_reach_their_goal_and_the_document_states_that_of_the_campaign() -> None:
    listed = load()[0]
    verdicts = current_verdicts(listed)
    examined = {verdict.mutant.what for verdict in verdicts}
    assert {mutant.what for mutant in listed if removes(mutant)} <= examined, (
        "each rule and each guard"
    )
    (tests, total), (campaign, of_campaign) = count_kills(verdicts)
    assert total >= 50
    assert tests >= TESTS_GOAL * total
    met = campaign >= CAMPAIGN_GOAL * of_campaign
    assert ("75 % is met" if met else "75 % is **missed**") in DOCUMENT.read_text(encoding="utf-8")
    survivors = [
        verdict.mutant for verdict in verdicts if "" in (verdict.by_tests, verdict.by_campaign)
    ]
    assert [mutant.what for mutant in survivors if not mutant.lives] == [], "without a reason"


def test_the_document_shows_the_stored_results() -> None:
    listed = load()[0]
    assert DOCUMENT.read_text(encoding="utf-8") == document(current_verdicts(listed), len(listed))


def test_the_named_fast_tests_exist() -> None:
    assert all(list(ROOT.glob(pattern)) for pattern in mutants.ALL_FAST)
