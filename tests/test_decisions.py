"""The records of docs/decisions: their form, their index, and the references to them."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
RECORDS = sorted((ROOT / "docs" / "decisions").glob("[0-9]*.md"))
NUMBERS = {record.name[:2] for record in RECORDS}
TEXTS = sorted(
    path
    for folder in ("membrane_ctrl", "firmware_iface", "tuning", "docs")
    for path in (ROOT / folder).rglob("*")
    if path.suffix in {".py", ".md", ".toml"}
)


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: record.name)
def test_a_record_has_context_decision_and_consequences(record: Path) -> None:
    title, *parts = re.findall(r"^#+ .*", record.read_text(), re.MULTILINE)
    assert title.startswith(f"# {record.name[:2]}. ")
    assert parts == ["## Context", "## Decision", "## Consequences"]


def test_the_index_lists_every_record_once_in_order_under_its_number() -> None:
    index = (ROOT / "docs" / "decisions" / "INDEX.md").read_text()
    assert re.findall(r"\[(\d+)\]\(([^)]*)\)", index) == [
        (record.name[:2], record.name) for record in RECORDS
    ]
    assert len(NUMBERS) == len(RECORDS)


def test_references_name_a_record_that_exists() -> None:
    names = {record.name for record in RECORDS} | {"INDEX.md"}
    wrong, seen = [], 0
    for path in TEXTS:
        text = path.read_text()
        found = re.findall(r"decisions/([\w-]+\.md)", text)
        numbers = re.findall(r"\bdecision\s+(\d+)", text)
        seen += len(found) + len(numbers)
        wrong += [f"{path}: {name}" for name in found if name not in names]
        wrong += [f"{path}: decision {number}" for number in numbers if number not in NUMBERS]
    assert wrong == []
    assert seen > 20
