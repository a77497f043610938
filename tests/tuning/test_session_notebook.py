"""The worked notebook does what it says: its cells run in order, and end with gains that are kept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).parents[2] / "docs" / "notebooks" / "tune.ipynb"


def code() -> list[str]:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_what_the_notebook_imports_is_there() -> None:
    lines = "\n".join(code()).splitlines()
    exec("\n".join(line for line in lines if line.startswith(("from ", "import "))), {})


@pytest.mark.campaign
def test_the_notebook_runs_from_top_to_bottom(capsys: pytest.CaptureFixture[str]) -> None:
    space: dict[str, Any] = {}
    for number, source in enumerate(code()):
        exec(compile(source, f"cell {number}", "exec"), space)
    said = capsys.readouterr().out
    assert "ziegler-nichols" in said
    assert space["done"].quality.verdict in ("ok", "degraded")
    assert space["stage"].reason == ""
    assert space["rig"].loop == space["proposal"].loop
    assert 0.7 < space["true_um"] / space["proposal"].chosen.predicted.std_um < 1.4


def test_the_notebook_is_stored_without_outputs() -> None:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert not any(cell.get("outputs") for cell in cells)
