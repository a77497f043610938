"""The list of the numerics' mutants, its page and what draws it."""

from __future__ import annotations

import ast
from collections import Counter

import numerics
from mutants import ROOT

APPLIES = 0.8  # of the list: statements change; a new draw replaces those that are gone


def changed(source: str) -> set[str]:
    nodes = ast.walk(ast.parse(source))
    return {change.text for node in nodes for change in numerics.list_changes(node, source)}


def test_each_kind_of_expression_is_exchanged() -> None:
    assert changed("a + b") == {"(a) - (b)"}
    assert changed("a / b") == {"(a) * (b)"}
    assert changed("a ** b") == {"(a) ** (1 + b)"}
    assert changed("a < b") == {"a > b"}
    assert changed("-a") == {"(a)"}
    assert changed("np.cos(a)") == {"np.sin"}
    assert changed("f(2.5)") == {"5.0"}
    assert changed("other.cos(a)") == set()


def test_most_mutations_apply_and_no_two_have_the_same_words() -> None:
    mutants, tests = numerics.load()
    assert len(mutants) >= 40
    assert {mutant.area for mutant in mutants} == set(numerics.PACKAGES) == tests.keys()
    assert max(Counter(mutant.what for mutant in mutants).values()) == 1
    paths = (ROOT / numerics.METROLOGY).rglob("*.py")
    product = "\n".join(path.read_text(encoding="utf-8") for path in paths)
    applies = [mutant for mutant in mutants if product.count(mutant.find) == 1]
    assert len(applies) >= APPLIES * len(mutants)


def test_the_tests_that_run_exist() -> None:
    _, tests = numerics.load()
    assert all((ROOT / file).exists() for files in tests.values() for file in files)


def test_the_page_shows_the_stored_results() -> None:
    mutants, _ = numerics.load()
    assert numerics.DOCUMENT.read_text(encoding="utf-8") == numerics.page(mutants)
