"""The safety case is complete and its page is the present one;
what would leave it open is found.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import safety_case
from safety_case import DOCUMENT, Constraint, External, find_gaps, load_case, make_page


def test_nothing_is_open() -> None:
    assert list(find_gaps(load_case())) == []


def test_the_page_is_the_present_one() -> None:
    assert DOCUMENT.read_text(encoding="utf-8") == make_page(load_case())


def test_a_hazard_that_no_constraint_prevents_is_open() -> None:
    case = load_case()
    without = [constraint for constraint in case.constraints if "H7" not in constraint.hazards]
    assert "H7: no constraint prevents it" in find_gaps(replace(case, constraints=without))


@pytest.mark.parametrize(
    ("constraint", "gap"),
    [
        (Constraint("C99", ["H1"], "", ""), "C99: nothing enforces it"),
        (Constraint("C99", ["H99"], "", "", rules=["late"]), "C99: unknown hazard H99"),
        (
            Constraint("C99", ["H1"], "", "", rules=["no_rule"]),
            "C99: the safety table has no rule no_rule",
        ),
        (Constraint("C99", ["H1"], "", "", guards=["NO_GUARD"]), "C99: there is no guard NO_GUARD"),
        (
            Constraint("C99", ["H1"], "", "", board=["no_fault"]),
            "C99: the board has no fault no_fault",
        ),
        (
            Constraint("C99", ["H1"], "", "", tests=["tests/conftest.py"]),
            "C99: tests/conftest.py has no test",
        ),
        (
            Constraint("C99", ["H1"], "", "", external=[External("net", "No such step")]),
            "C99: docs/how-to/operations.md has no step 'No such step' for the net",
        ),
    ],
)
def test_a_constraint_without_its_proof_is_open(constraint: Constraint, gap: str) -> None:
    case = load_case()
    assert gap in find_gaps(replace(case, constraints=[*case.constraints, constraint]))


def test_a_rule_without_a_killed_mutant_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safety_case, "find_killed", dict)
    gaps = list(find_gaps(load_case()))
    assert "C13: no killed mutant removes rule late" in gaps
    assert "C10: no killed mutant removes guard MANUAL_RANGE" in gaps
