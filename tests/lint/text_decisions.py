"""Finds decisions that are taken on a text made for people; `python -m tests.lint.text_decisions`
lists them.

A sentence may be improved at any time, so no code may depend on its words: a code, an enum or a
flag decides, and the sentence is made where it is shown. A text for people is `str` of a caught
exception, and whatever is called as such texts are called (`why`, `reason`, `message`, ...) unless
its annotation or value in the same file shows that it is no text. A decision is a test of its
words: `startswith`, `in`, `==` with a literal, a regular expression, or taking it apart at a word.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
TOPS = ("membrane_ctrl", "firmware_iface", "tuning")

_TEXTS = frozenset(
    {
        "why",
        "reason",
        "message",
        "sentence",
        "remedy",
        "cause",
        "says",
        "said",
        "told",
        "words",
        "note",
        "problem",
        "refusal",
        "refused",
        "failure",
        "outcome",
    }
)
_WORD = re.compile("[A-Za-z]{2,}")
_TESTS = frozenset({"startswith", "endswith"})
_DISSECTIONS = frozenset({"find", "index", "partition", "rpartition", "translate"})
_PATTERNS = frozenset({"match", "search", "fullmatch"})

# Functions that may: `file:function` and why.
EXCEPTIONS: dict[str, str] = {
    "membrane_ctrl/config/toml_file.py:_describe_cause": "the parser of TOML gives no more than a message",  # noqa: E501
    "membrane_ctrl/config/toml_file.py:describe_error": "joins a message to its key; only a point or a colon depends on it",  # noqa: E501
    "membrane_ctrl/model/errors.py:name_source_in_errors": "puts a file's name before a message; nothing but the message changes",  # noqa: E501
    "firmware_iface/driver_calls.py:_name_device": "puts a device's name before a message without it",  # noqa: E501
}


@dataclass(frozen=True)
class TextDecision:
    """A place where the words of a text decide.

    Attributes
    ----------
    path : str
        The file, relative to the root.
    line : int
    function : str
        The innermost function around it; empty at module level.
    expression : str
        The test.
    """

    path: str
    line: int
    function: str
    expression: str

    @property
    def key(self) -> str:
        """The function as `EXCEPTIONS` names it."""
        return f"{self.path}:{self.function}"


class _Finder(ast.NodeVisitor):
    """Collects the decisions of one file."""

    def __init__(self, path: str, tree: ast.Module) -> None:
        self._path = path
        self._not_texts = _names_of_other_types(tree)
        self._functions: list[str] = []
        self._caught: list[str] = []
        self.found: list[TextDecision] = []
        self.visit(tree)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        """Remember the function."""
        self._enter(node)

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> None:
        """Remember the function."""
        self._enter(node)

    def visit_ExceptHandler(self, node: ast.ExceptHandler) -> None:
        """Remember the exception's name."""
        self._caught.append(node.name or "")
        self.generic_visit(node)
        self._caught.pop()

    def visit_Compare(self, node: ast.Compare) -> None:
        """Find `"word" in text` and `text == "word"`."""
        left, right = node.left, node.comparators[0]
        operator = node.ops[0]
        if isinstance(operator, ast.In | ast.NotIn) and self._is_text(right):
            self._note(node, _has_words(left) or _is_constant_name(left))
        elif isinstance(operator, ast.Eq | ast.NotEq):
            self._note(node, self._is_text(left) and _has_words(right))
            self._note(node, self._is_text(right) and _has_words(left))
        elif isinstance(operator, ast.In | ast.NotIn) and self._is_text(left):
            self._note(
                node,
                isinstance(right, ast.Tuple | ast.Set | ast.List)
                and any(map(_has_words, right.elts)),
            )
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        """Find methods of a text that test or dissect it, and regular expressions on it."""
        function = node.func
        if isinstance(function, ast.Attribute):
            if self._is_text(function.value):
                words = [each for argument in node.args for each in _elements(argument)]
                tests = function.attr in _TESTS and any(
                    _has_words(each) or not _is_literal(each) for each in words
                )
                self._note(node, tests or function.attr in _DISSECTIONS)
            self._note(node, function.attr in _PATTERNS and any(map(self._is_text, node.args)))
        self.generic_visit(node)

    def _enter(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        self._functions.append(node.name)
        self.generic_visit(node)
        self._functions.pop()

    def _is_text(self, node: ast.expr) -> bool:
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id == "str"
            and node.args
        ):
            argument = node.args[0]
            return (
                isinstance(argument, ast.Name) and argument.id in self._caught
            ) or self._is_text(argument)
        name = _last_name(node)
        return name.lstrip("_") in _TEXTS and name not in self._not_texts

    def _note(self, node: ast.expr, decides: bool) -> None:
        if decides:
            function = self._functions[-1] if self._functions else ""
            self.found.append(TextDecision(self._path, node.lineno, function, ast.unparse(node)))


def _last_name(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def _elements(node: ast.expr) -> list[ast.expr]:
    return node.elts if isinstance(node, ast.Tuple) else [node]


def _is_literal(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant)


def _has_words(node: ast.expr) -> bool:
    if isinstance(node, ast.JoinedStr):
        return True
    return (
        isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and bool(_WORD.search(node.value))
    )


def _is_constant_name(node: ast.expr) -> bool:
    return _last_name(node).lstrip("_").isupper()


def _names_of_other_types(tree: ast.Module) -> frozenset[str]:
    """Return names that the file declares as something else than a text,
    or fills with a container.
    """
    names = set[str]()
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.arg)
            and node.annotation is not None
            and not _declares_text(node.annotation)
        ):
            names.add(node.arg)
        elif isinstance(node, ast.AnnAssign) and not _declares_text(node.annotation):
            names.add(_last_name(node.target))
        elif isinstance(node, ast.Assign) and _is_container(node.value):
            names.update(_last_name(target) for target in node.targets)
    return frozenset(names)


def _declares_text(annotation: ast.expr) -> bool:
    return (
        re.fullmatch(r"'?(\(?str\)?|Any|object)( \| None)?'?", ast.unparse(annotation)) is not None
    )


def _is_container(value: ast.expr) -> bool:
    if isinstance(value, ast.Call):
        return _last_name(value.func) in {
            "set",
            "frozenset",
            "list",
            "dict",
            "tuple",
            "deque",
            "Counter",
        }
    kinds = ast.Set | ast.List | ast.Dict | ast.Tuple | ast.SetComp | ast.ListComp | ast.DictComp
    return isinstance(value, kinds)


def decisions_in(path: str, source: str) -> list[TextDecision]:
    """Return the decisions on texts in a file's source, in order."""
    return sorted(_Finder(path, ast.parse(source)).found, key=lambda each: each.line)


def decisions(root: Path = ROOT) -> Iterator[TextDecision]:
    """Yield the decisions on texts in the product, also those of `EXCEPTIONS`."""
    for top in TOPS:
        for path in sorted((root / top).rglob("*.py")):
            yield from decisions_in(
                path.relative_to(root).as_posix(), path.read_text(encoding="utf-8")
            )


def main() -> int:
    """Print every decision on a text, and every exception that is none;
    return 1 if there is one.
    """
    found = list(decisions())
    keys = {each.key for each in found}
    wrong = [
        f"{each.path}:{each.line}: decides on a text: {each.expression}"
        for each in found
        if each.key not in EXCEPTIONS
    ]
    wrong += [f"{key}: this exception is not needed" for key in EXCEPTIONS if key not in keys]
    print("\n".join(wrong) or "no decision is taken on a text made for people")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
