"""Random mutations of the numerics of the metrology: do the tests of their package notice them?

python tests/mutants/numerics.py draw      # write numerics.toml: the same draw at every call
python tests/mutants/numerics.py           # examine those without a result, write the page
python tests/mutants/numerics.py page      # write the page from the stored results

A mutation exchanges one operator, comparison, function or number of a statement. Results are kept
in numerics_results.json; a mutation whose text has changed has none.
"""

from __future__ import annotations

import ast
import json
import random
import shutil
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from mutants import _LEAVE, _PYTEST, ROOT, Mutant, _failed_test, _run, mutated

METROLOGY = Path("membrane_ctrl/metrology")
LIST = Path(__file__).with_name("numerics.toml")
RESULTS = Path(__file__).with_name("numerics_results.json")
DOCUMENT = ROOT / "docs" / "measurements" / "numerics-mutants.md"
PACKAGES = ("uncertainty", "film", "calibration", "tracking", "reconstruction")
OF_PACKAGE = 10  # mutations that are drawn in each
SEED = 47
GOAL = 0.9
_OPERATORS: dict[type[ast.operator], str] = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
}
_COMPARISONS: dict[type[ast.cmpop], str] = {
    ast.Lt: ">",
    ast.Gt: "<",
    ast.LtE: ">",
    ast.GtE: "<",
    ast.Eq: "!=",
    ast.NotEq: "==",
}
_FUNCTIONS = {
    "cos": "sin",
    "sin": "cos",
    "sqrt": "abs",
    "hypot": "maximum",
    "maximum": "minimum",
    "minimum": "maximum",
    "mean": "median",
    "median": "max",
    "max": "min",
    "min": "max",
    "outer": "multiply.outer(1, 1) * np.outer",
    "square": "abs",
}


@dataclass(frozen=True)
class Change:
    """One expression, and what replaces it."""

    node: ast.expr
    text: str


def list_changes(node: ast.AST, source: str) -> Iterator[Change]:
    """What one expression can be exchanged for.

    Parameters
    ----------
    node : ast.AST
    source : str
        Text of the module.
    """
    if isinstance(node, ast.BinOp):
        left, right = _texts(source, node.left, node.right)
        if isinstance(node.op, ast.Pow):
            yield Change(node, f"({left}) ** (1 + {right})")
        elif (other := _OPERATORS.get(type(node.op))) is not None:
            yield Change(node, f"({left}) {other} ({right})")
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield from (Change(node, f"({operand})") for operand in _texts(source, node.operand))
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        left, right = _texts(source, node.left, node.comparators[0])
        if (other := _COMPARISONS.get(type(node.ops[0]))) is not None:
            yield Change(node, f"{left} {other} {right}")
    elif isinstance(node, ast.Attribute) and node.attr in _FUNCTIONS:
        (value,) = _texts(source, node.value)
        if value == "np":
            yield Change(node, f"np.{_FUNCTIONS[node.attr]}")
    elif isinstance(node, ast.Constant) and isinstance(node.value, float) and node.value:
        yield Change(node, repr(2 * node.value))


def _texts(source: str, *nodes: ast.expr) -> list[str]:
    return [ast.get_source_segment(source, node) or "" for node in nodes]


def list_mutants(path: Path, sources: str) -> list[Mutant]:
    """All mutations of a module whose statement occurs once in the product.

    Parameters
    ----------
    path : Path
        Of the module.
    sources : str
        Text of the whole product.
    """
    source = path.read_text(encoding="utf-8")
    found = []
    for function in _functions(ast.parse(source)):
        for statement in ast.walk(function):
            if not isinstance(statement, (ast.Assign, ast.AugAssign, ast.Return, ast.AnnAssign)):
                continue
            whole = ast.get_source_segment(source, statement) or ""
            if sources.count(whole) != 1:
                continue
            for node in ast.walk(statement):
                for change in list_changes(node, source):
                    old = ast.get_source_segment(source, change.node) or ""
                    if whole.count(old) != 1:
                        continue
                    what = f"{path.parent.name}/{path.name}, {function.name}: {_line(old)}"
                    mutant = Mutant(
                        what=f"{what} becomes {_line(change.text)}",
                        area=path.parent.name,
                        find=whole,
                        replace=whole.replace(old, change.text),
                    )
                    found.append(mutant)
    return found


def _functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """The functions and methods of a module, without those inside a function."""
    for node in tree.body:
        inside = node.body if isinstance(node, ast.ClassDef) else [node]
        yield from (each for each in inside if isinstance(each, ast.FunctionDef))


def _line(text: str) -> str:
    return " ".join(text.split())


def draw_mutants() -> list[Mutant]:
    """So many of each package, at random: the same at every call for the same source."""
    product = "\n".join(
        path.read_text(encoding="utf-8")
        for folder in ("membrane_ctrl", "firmware_iface")
        for path in sorted((ROOT / folder).rglob("*.py"))
    )
    rng = random.Random(SEED)
    drawn = []
    for package in PACKAGES:
        listed: dict[str, Mutant] = {}
        for path in sorted((ROOT / METROLOGY / package).glob("*.py")):
            listed |= {mutant.what: mutant for mutant in list_mutants(path, product)}
        drawn += rng.sample(list(listed.values()), OF_PACKAGE)
    return drawn


def write_list(mutants: Sequence[Mutant], tests: dict[str, list[str]]) -> None:
    """Write numerics.toml."""
    lines = [
        "# Drawn by `python tests/mutants/numerics.py draw`; `lives` says why a mutation may "
        "survive.",
        "",
        "# Test files of each package that run on its mutations, in this order.",
        "[tests]",
        *(f"{name} = {json.dumps(files)}" for name, files in tests.items()),
    ]
    for mutant in mutants:
        lines += ["", "[[mutant]]"]
        for key in ("what", "area", "find", "replace", "lives"):
            lines.append(f"{key} = {json.dumps(getattr(mutant, key), ensure_ascii=False)}")
    LIST.write_text("\n".join(lines) + "\n", encoding="utf-8")


def load() -> tuple[list[Mutant], dict[str, list[str]]]:
    """All mutations, and the test files of each package."""
    table = tomllib.loads(LIST.read_text(encoding="utf-8"))
    return [Mutant(**entry) for entry in table.get("mutant", [])], table["tests"]


def load_results() -> dict[str, dict[str, str]]:
    """Text and first failed test of each examined mutation, by its words."""
    if not RESULTS.exists():
        return {}
    results: dict[str, dict[str, str]] = json.loads(RESULTS.read_text(encoding="utf-8"))
    return results


def current_results(mutants: Sequence[Mutant]) -> list[tuple[Mutant, str]]:
    """Mutations whose present text was examined, with the test that fails; empty: it survives."""
    results = load_results()
    return [
        (mutant, results[mutant.what]["by_tests"])
        for mutant in mutants
        if results.get(mutant.what, {}).get("digest") == mutant.digest
    ]


def examine_missing() -> None:
    """Examine the mutations without a result, one after the other, in a copy of the tree."""
    mutants, tests = load()
    known = {mutant.what for mutant, _ in current_results(mutants)}
    missing = [mutant for mutant in mutants if mutant.what not in known]
    missing.sort(
        key=lambda mutant: PACKAGES.index(mutant.area), reverse=True
    )  # the fast ones first
    with tempfile.TemporaryDirectory(prefix="numerics-") as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, ignore=_LEAVE)
        for mutant in missing:
            begun_s = time.monotonic()
            with mutated(tree, mutant):
                files = sorted_tests(tree, mutant, tests[mutant.area])
                found = _failed_test(_run(tree, "-m", "pytest", *_PYTEST, *files))
            results = load_results()
            results[mutant.what] = {"digest": mutant.digest, "by_tests": found}
            text = json.dumps(results, indent=1, sort_keys=True, ensure_ascii=False)
            RESULTS.write_text(text + "\n", encoding="utf-8")
            lasted_s = time.monotonic() - begun_s
            print(f"{lasted_s:4.0f} s  {mutant.what}: {found or 'LIVES'}", flush=True)


def sorted_tests(tree: Path, mutant: Mutant, files: Sequence[str]) -> list[str]:
    """The test files of a package, those first that name the mutated module."""
    module = mutant.what.split(",")[0].removesuffix(".py").split("/")[1]
    return sorted(files, key=lambda file: module not in (tree / file).read_text(encoding="utf-8"))


def page(mutants: Sequence[Mutant]) -> str:
    """The results as Markdown."""
    examined = current_results(mutants)
    killed = sum(bool(found) for _, found in examined)
    share = 100 * killed / max(len(examined), 1)
    goal = f"the goal of {100 * GOAL:.0f} % is {'met' if share >= 100 * GOAL else '**missed**'}"
    share_of_all = 100 * killed / max(len(mutants), 1)
    if len(examined) < len(mutants) and share_of_all >= 100 * GOAL:
        goal = (
            f"the goal of {100 * GOAL:.0f} % is met whatever the others are: "
            f"{share_of_all:.0f} % of all are killed"
        )
    elif len(examined) < len(mutants):
        goal = (
            f"whether the goal of {100 * GOAL:.0f} % is met is not known. A mutation that survives "
            "takes longest to examine, so that the share of some is too high: at least "
            f"{share_of_all:.0f} % of all are killed"
        )
    lines = [
        "# Mutants of the numerics",
        "",
        "Generated by `python tests/mutants/numerics.py`: one operator, comparison, function or "
        "number is exchanged in statements drawn at random from the numerics, and the fast tests "
        "of the package run.",
        "",
        f"{len(mutants)} mutations are listed, {len(examined)} were examined. **The tests kill "
        f"{killed} of {len(examined)} ({share:.0f} %)**; {goal}.",
        "",
        "| mutation | killed by |",
        "|---|---|",
    ]
    lines += [
        f"| `{mutant.what.replace('|', '/')}` | {f'`{found}`' if found else '**no test**'} |"
        for mutant, found in examined
    ]
    lines += ["", "## Survivors", ""]
    lines += [
        f"- `{mutant.what}`: {mutant.lives or 'not explained'}"
        for mutant, found in examined
        if not found
    ]
    known = {mutant.what for mutant, _ in examined}
    lines += [
        f"- `{mutant.what}`: not examined; {mutant.lives or 'no reason to live is known'}"
        for mutant in mutants
        if mutant.what not in known
    ]
    return "\n".join(lines).rstrip() + "\n"


def main(arguments: Sequence[str]) -> None:
    """Draw the list, or examine what is missing; write the page."""
    if "draw" in arguments:
        write_list(draw_mutants(), load()[1])
        return
    if "page" not in arguments:
        examine_missing()
    DOCUMENT.write_text(page(load()[0]), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
