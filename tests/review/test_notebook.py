"""The worked notebook runs on a run, cell by cell."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib as mpl
import pytest

from benchmarks.nights import Planted
from tests.support.review_runs import written

NOTEBOOK = Path(__file__).parents[2] / "docs" / "notebooks" / "review.ipynb"


def test_the_notebook_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RUN", str(written(tmp_path, 0.2, [Planted("pressure step", 400.0, 20.0)])))
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    names: dict[str, object] = {}
    with mpl.rc_context({"backend": "agg"}):
        for cell in cells:
            exec(compile("".join(cell["source"]), NOTEBOOK.name, "exec"), names)
        names["plt"].close("all")  # type: ignore[attr-defined]
    said = capsys.readouterr().out
    assert "600 ticks" in said
    assert "180 cycles" in said
    assert "found: pressure step, 2" in said
