"""The committed page of the paper: its numbers are those that the program computes."""

from __future__ import annotations

import json
from typing import Any

import pytest

from membrane_ctrl.paper import pictures
from membrane_ctrl.paper.bench import PaperBench, PaperOptions
from membrane_ctrl.paper.comparison import round_numbers
from membrane_ctrl.paper.parts import PARTS
from tests.support.paper_page import DOCS, make_page

# Parts whose numbers do not depend on the frames' size, or that take only seconds.
QUICK_PARTS = ("gray", "gradients")


@pytest.fixture(scope="module")
def committed() -> dict[str, Any]:
    table: dict[str, Any] = json.loads((DOCS / "paper.json").read_text())
    return table


def test_the_page_shows_the_committed_numbers(committed: dict[str, Any]) -> None:
    files = {path.name for path in DOCS.iterdir()}
    page = (DOCS / "index.md").read_text()
    for name, rows in committed["comparisons"].items():
        for row in rows:
            assert " | ".join(cell.replace("|", "/") for cell in row) in page, name
    shown = {line.split("](")[1][:-1] for line in page.splitlines() if line.startswith("![")}
    assert shown == files - {"index.md", "paper.json"}
    assert list(committed["comparisons"]) == [part.name for part in PARTS]


@pytest.mark.parametrize("name", QUICK_PARTS)
def test_numbers_are_computed_again(
    name: str, committed: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "to_png", lambda _: b"")
    check_part(name, committed)


@pytest.mark.campaign
@pytest.mark.timeout(3600)
def test_all_numbers_are_computed_again(committed: dict[str, Any]) -> None:
    for part in PARTS:
        check_part(part.name, committed)  # seconds are none of its numbers


def check_part(name: str, committed: dict[str, Any]) -> None:
    """Compute one part with the committed options, and compare it."""
    options = PaperOptions(
        committed["shrink"], committed["sets"], committed["trials"], committed["seed"]
    )
    part = next(part for part in PARTS if part.name == name)
    found = flatten(round_numbers(part.compute(PaperBench(options)).numbers))
    stated = flatten(committed["numbers"][name])
    assert list(found) == list(stated)
    for key, value in stated.items():
        expected = pytest.approx(value, rel=1e-6) if isinstance(value, float) else value
        assert found[key] == expected, key


def flatten(value: Any, name: str = "") -> dict[str, Any]:
    """Numbers by their path."""
    if isinstance(value, dict):
        return {
            key: number
            for child, each in value.items()
            for key, number in flatten(each, f"{name}/{child}").items()
        }
    if isinstance(value, list):
        return flatten(dict(enumerate(value)), name)
    return {name: value}


def test_a_page_of_a_document_without_some_parts(committed: dict[str, Any]) -> None:
    only = {**committed, "comparisons": {"gray": committed["comparisons"]["gray"]}}
    page = make_page(only, {"gray": []})
    assert "Gray-code table" in page
    assert "Monte Carlo of the height" not in page
