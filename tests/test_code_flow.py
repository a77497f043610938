"""Files and functions that docs/ names exist, and the counts of files in
docs/explanation/code-flow.md are right.
"""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TOPS = ("membrane_ctrl", "firmware_iface", "tuning", "tests", "benchmarks")
PAGE = (ROOT / "docs" / "explanation" / "code-flow.md").read_text()
WALKS = {part[0]: part for part in re.split(r"^## (?=\w\. )", PAGE, flags=re.MULTILINE)[1:]}
COUNTS = dict(re.findall(r"^\| \[(\w)\. .*?\]\(.*?\) \| (\d+)", PAGE, re.MULTILINE))
STEP = re.compile(r"^\| (\d+) \| `([^`]+)` \| (.+?) \|", re.MULTILINE)


def path_of(name: str) -> Path:
    """Where a file of the page is."""
    return ROOT / (
        name if name.startswith(("firmware_iface/", "tuning/")) else f"membrane_ctrl/{name}"
    )


def defined_in(path: Path) -> set[str]:
    """Functions and classes of a module, and the methods as `Class.method`."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            methods = (
                n for n in node.body if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)
            )
            found.update(f"{node.name}.{method.name}" for method in methods)
    return found


@pytest.mark.parametrize("walk", WALKS)
def test_every_name_of_a_walk_exists(walk: str) -> None:
    steps = STEP.findall(WALKS[walk])
    assert [int(number) for number, _, _ in steps] == list(range(1, len(steps) + 1))
    for _, file, names in steps:
        named = set(re.findall(r"`([^`]+)`", names))
        assert named, file
        assert named <= defined_in(path_of(file)), file


@pytest.mark.parametrize("walk", WALKS)
def test_the_count_of_files_is_right(walk: str) -> None:
    assert len({file for _, file, _ in STEP.findall(WALKS[walk])}) == int(COUNTS[walk])


def test_every_file_that_the_prose_names_exists() -> None:
    names = re.findall(r"`([\w/]+\.py)`", PAGE)
    missing = [name for name in names if not path_of(name).exists() and not (ROOT / name).exists()]
    assert missing == []


@pytest.mark.parametrize("page", sorted((ROOT / "docs").rglob("*.md")), ids=lambda page: page.name)
def test_a_python_file_that_a_page_names_exists(page: Path) -> None:
    known = [path.as_posix() for top in TOPS for path in (ROOT / top).rglob("*.py")]
    named = re.findall(r"`([\w/]+\.py)\b", page.read_text())
    assert [name for name in named if not any(path.endswith(f"/{name}") for path in known)] == []
