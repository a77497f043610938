"""The check that no decision is taken on a text made for people."""

from __future__ import annotations

import ast
import textwrap

import pytest

from tests.lint import text_decisions
from tests.lint.text_decisions import EXCEPTIONS, TextDecision, decisions, decisions_in


def expressions_in(source: str) -> list[str]:
    return [each.expression for each in decisions_in("file.py", textwrap.dedent(source))]


@pytest.fixture(scope="module")
def found() -> list[TextDecision]:
    """Those of the product."""
    return list(decisions())


def test_the_product_takes_no_decision_on_a_text(found: list[TextDecision]) -> None:
    wrong = [
        f"{each.path}:{each.line}: {each.expression}"
        for each in found
        if each.key not in EXCEPTIONS
    ]
    assert wrong == []


def test_every_exception_is_needed(found: list[TextDecision]) -> None:
    assert set(EXCEPTIONS) <= {each.key for each in found}


@pytest.mark.parametrize(
    "expression",
    [
        'why.startswith("paused")',
        'status.why.startswith("paused")',
        'flag.reason.startswith(("moved", "differs"))',
        "finished.reason.startswith(STOPPED)",
        'outcome.endswith(": done")',
        '"pause" in why',
        '"pause" not in self._why',
        "MAP_THE_PUMP in error.message",
        'verdict.reason == "not recorded"',
        '"no answer" != message',
        'problem in ("no light", "dark")',
        're.search("at line [0-9]+", message)',
        "_PATTERN.fullmatch(sentence)",
        'outcome.partition(":")',
        "shape.reason.translate(NO_DIGITS)",
        'str(event.why).startswith("paused")',
    ],
)
def test_a_test_of_words_is_found(expression: str) -> None:
    assert expressions_in(f"x = {expression}") == [ast.unparse(ast.parse(expression))]


def test_a_caught_exception_as_text_is_found_wherever_its_words_decide() -> None:
    source = """
        try:
            act()
        except ValueError as problem_of_act:
            if str(problem_of_act).startswith("faults") or MAP in str(problem_of_act):
                raise
        if "words" in str(number):
            act()
    """
    assert expressions_in(source) == [
        "str(problem_of_act).startswith('faults')",
        "MAP in str(problem_of_act)",
    ]


@pytest.mark.parametrize(
    "expression",
    [
        'line.startswith("#")',
        'text.partition("=")',
        'name in ("a", "b")',
        "bool(why)",
        'why == ""',
        'message[:1] == "T"',
        'why or "as it should be"',
        'why.endswith("\\n")',
        '" ".join(message.split())',
        'message.removeprefix("Value error, ")',
        'f"{name}: {reason}"',
        'table["reason"] == "late"',
        "len(reason) > 5",
    ],
)
def test_what_takes_no_decision_on_words_passes(expression: str) -> None:
    assert expressions_in(f"x = {expression}") == []


@pytest.mark.parametrize(
    "source",
    [
        'def kind_of(message: dict[str, int]) -> bool:\n    return "number" in message',
        'def kind_of(message: Message) -> bool:\n    return "number" in message',
        'words = {"a": 1}\nx = "apple" in words',
        'told = set()\nx = "apple" in told',
        'self.said: frozenset[str] = given\nx = "apple" in self.said',
        'x = [word for word in ("apple", "pear") if word in words]',
    ],
)
def test_a_container_with_such_a_name_is_no_text(source: str) -> None:
    assert expressions_in(source) == []


@pytest.mark.parametrize("annotation", ["str", "str | None", "Any", "object"])
def test_an_annotation_that_allows_a_text_keeps_it_one(annotation: str) -> None:
    assert expressions_in(f'def f(why: {annotation}) -> bool:\n    return "apple" in why') == [
        "'apple' in why"
    ]


def test_a_decision_names_its_place() -> None:
    source = 'class A:\n    def f(self):\n        return "apple" in self.why\n'
    (found,) = decisions_in("folder/file.py", source)
    assert (found.line, found.key) == (3, "folder/file.py:f")


def test_the_command_lists_decisions_and_exceptions_that_are_none(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = decisions_in("a.py", 'x = "apple" in why')
    monkeypatch.setattr(text_decisions, "decisions", lambda: iter(found))
    monkeypatch.setattr(text_decisions, "EXCEPTIONS", {"b.py:f": "why not"})
    assert text_decisions.main() == 1
    assert capsys.readouterr().out.splitlines() == [
        "a.py:1: decides on a text: 'apple' in why",
        "b.py:f: this exception is not needed",
    ]
    monkeypatch.setattr(text_decisions, "EXCEPTIONS", {"a.py:": "a module"})
    assert text_decisions.main() == 0
