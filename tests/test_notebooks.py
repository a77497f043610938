"""The notebooks of docs/notebooks run, and store what they print and draw."""

from __future__ import annotations

import json
import re
from pathlib import Path

import nbformat
import pytest

from tests.support.notebooks import FOLDER, NAMES, executed, text_of

_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def _pictures(notebook: nbformat.NotebookNode) -> int:
    return json.dumps(notebook).count('"image/png"')


@pytest.mark.campaign  # half a minute each; CI runs them
@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_shows_what_is_stored_in_it(name: str, tmp_path: Path) -> None:
    stored = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    fresh = executed(name, tmp_path)
    texts, again = text_of(stored), text_of(fresh)
    assert _NUMBER.sub("#", again).split() == _NUMBER.sub("#", texts).split()
    expected = [float(number) for number in _NUMBER.findall(texts)]
    assert [float(number) for number in _NUMBER.findall(again)] == pytest.approx(
        expected, rel=0.1, abs=0.02
    )
    assert _pictures(fresh) == _pictures(stored) >= 1


@pytest.mark.parametrize("name", NAMES)
def test_a_stored_notebook_ran_from_top_to_bottom_and_names_no_path_of_a_machine(name: str) -> None:
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert all(output.output_type != "error" for cell in cells for output in cell.outputs)
    assert not re.search(r"/(root|home|tmp|usr|work)/", text_of(notebook))
