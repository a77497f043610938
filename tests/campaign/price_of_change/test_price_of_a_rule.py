"""A new rule of the safety table costs its row, and the field of the observation that it judges.

The two are written into a copy of the source. Then the rule trips, and it is in the documentation,
in the list of the fault matrix and in that of the mutants. What remains is evidence, and a person
must write it: an observation that shows the cause (`tests/controller/test_safety.py`), and the
constraint that the rule enforces (`tests/safety_case/safety_case.toml`).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from changed_source import ChangedSource

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(1800)]

RULE, CAUSE, REMEDY = (
    "gas_hot",
    "the gas is hotter than the film stands",
    "find what heats the mirror",
)
FIELD = '''\

@property
def gas_temperature_c(self) -> float:
    """Of the gas in the mirror; NaN without an answer."""
    return self.reading.gas_temperature_c
'''
ROW = f"""\
Rule(
    code=27, name="{RULE}", cause="{CAUSE}",
    limit="60 °C", safe_level=SafeLevel.RAMP_DOWN, seen_in=_TWICE, states=CONNECTED,
    remedy="{REMEDY}",
    seen=lambda o: f"{{o.gas_temperature_c:.0f}} °C",
    broken=lambda o, c: o.gas_temperature_c > 60.0,
)
"""
BENCH = Path(__file__).with_name("rule_bench.py")


def apply_change(source: ChangedSource) -> None:
    """Make the change in a copy of the source."""
    source.add_field("Observation", FIELD)
    source.add_row("Rule", ROW)
    assert source.count_places() == 2


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> ChangedSource:
    """The product with one more rule: two places differ."""
    source = ChangedSource.copy_to(tmp_path_factory.mktemp("rule"))
    source.copy_more("tests", "docs", "benchmarks")
    apply_change(source)
    return source


@pytest.fixture(scope="module")
def shown(source: ChangedSource) -> dict[str, Any]:
    """Everything that the bench program prints."""
    bench = source.folder / BENCH.relative_to(Path(__file__).parents[3])
    found: dict[str, Any] = json.loads(source.run_python(bench, RULE, "gas_temperature_c", 85.0))
    return found


def test_it_trips_and_its_event_has_the_sentence_of_every_fault(shown: dict[str, Any]) -> None:
    fault, entered = shown["events"]
    assert (fault["kind"], fault["code"], fault["name"], fault["seen"]) == (
        "fault",
        27,
        RULE,
        "85 °C",
    )
    assert (fault["safe_level"], fault["latching"], fault["remedy"]) == ("ramp_down", True, REMEDY)
    assert (entered["kind"], entered["state"]) == ("state", "fault")


def test_the_pages_have_it(source: ChangedSource) -> None:
    source.run_python("-m", "tests.support.faults_page")
    assert (
        f"| 27 | `{RULE}` | {CAUSE} |"
        in (source.folder / "docs" / "reference" / "faults.md").read_text()
    )
    assert (
        f"| 27 `{RULE}` | {CAUSE} | {REMEDY} |"
        in (source.folder / "docs" / "how-to" / "operations.md").read_text()
    )


def test_the_fault_matrix_lists_it(shown: dict[str, Any]) -> None:
    (row,) = shown["matrix"]
    assert row.startswith(f"| 27 `{RULE}` |")


def test_the_mutants_list_removes_it(shown: dict[str, Any]) -> None:
    assert shown["mutant"]["what"] == f"{RULE} never trips"
    assert Path(shown["mutant"]["place"]).name == "safety.py"


def test_the_evidence_that_a_person_must_write_is_missed(source: ChangedSource) -> None:
    gaps = (
        "import safety_case as s; print([g for g in s.find_gaps(s.load_case()) if 'gas_hot' in g])"
    )
    output = source.run_python("-c", f"import sys; sys.path.insert(0, 'tests/safety_case'); {gaps}")
    assert f"rule {RULE}: enforces no constraint" in output
