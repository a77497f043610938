"""The examples of docs/how-to/data.md run, where runs and results are,
and give the figures of `report`.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.review import open_run
from membrane_ctrl.review.report.json import report_table
from membrane_ctrl.review.statistics.analysis import analyse_run
from tests.support.dask_cluster import PATIENT
from tests.support.review_runs import written

PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "data.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
NIGHTS = [f"2026112{day}T180000Z-night" for day in (1, 2, 3)]
HOLD = 4  # the code of the state
Figures = Mapping[str, tuple[int, int, float]]  # by run: ticks, settled ones, standard deviation


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs, a result of `measure` with its FITS file, and a result of `stability`."""
    folder = tmp_path_factory.mktemp("lab")
    for seed, name in enumerate(NIGHTS, start=1):
        written(folder / "logs", 0.03, seed=seed, name=name)
    assert run(["simulate", str(folder / "sets"), "--shrink", "12", "--sets", "2"]) == 0
    assert run(["stability", str(folder / "sets")]) == 0
    (folder / "sets" / "0000").rename(folder / "set")
    result = folder / "set" / "result"
    assert run(["measure", str(folder / "set"), "--no-pictures"]) == 0
    assert (
        run(["export-figure", str(result), "--format", "fits", "--remove", "piston,tilt,power"])
        == 0
    )
    return folder


@pytest.fixture(scope="module")
def reported(lab: Path) -> Figures:
    """The figures of `report`."""
    tables = [report_table(analyse_run(open_run(lab / "logs" / name))) for name in NIGHTS]
    return {
        table["run"]: (table["ticks"], table["ticks_settled"], table["std_single_ticks_um"])
        for table in tables
    }


def example_with(words: str) -> str:
    """The only example that contains these words."""
    (example,) = (text for text in EXAMPLES if words in text)
    return example


def executed(example: str, lab: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.chdir(lab)
    space: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(example, PAGE.name, "exec"), space)
    return space


def check_figures(rows: list[Mapping[str, Any]], reported: Figures) -> None:
    """The same runs and counts, and deviations to 1e-9."""
    assert {row["run"]: (row["ticks"], row["settled"]) for row in rows} == {
        name: (ticks, settled) for name, (ticks, settled, _) in reported.items()
    }
    for row in rows:
        assert row["std_um"] == pytest.approx(reported[row["run"]][2], rel=1e-9)


def test_report_has_figures_to_compare_with(reported: Figures) -> None:
    assert all(
        0 < settled < ticks and 0.1 < std_um < 10 for ticks, settled, std_um in reported.values()
    )


@pytest.mark.parametrize("library", ["duckdb", "polars", "pandas"])
def test_a_library_gives_the_figures_of_report(
    library: str, lab: Path, reported: Figures, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = {"duckdb": "WITH marked", "polars": "import polars", "pandas": "import pandas"}[library]
    table = executed(example_with(words), lab, monkeypatch)["table"]
    check_figures(table.to_dicts() if library == "polars" else table.to_dict("records"), reported)


def test_a_cluster_of_two_workers_gives_the_figures_of_report(
    lab: Path, reported: Figures, tmp_path: Path
) -> None:
    """As a script of its own: workers import the script that starts them."""
    pandas = (
        example_with("import pandas").replace("table = ", "alone = ").replace("print(table)", "")
    )
    script = (
        pandas
        + example_with("dask.distributed")
        + "    table.to_json('dask.json', double_precision=15)\n"
    )
    (tmp_path / "script.py").write_text(script)
    subprocess.run(
        [sys.executable, tmp_path / "script.py"], check=True, cwd=lab, env=os.environ | PATIENT
    )
    columns = json.loads((lab / "dask.json").read_text())
    rows = [{name: values[number] for name, values in columns.items()} for number in columns["run"]]
    check_figures(rows, reported)


def test_the_other_examples_run(
    lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    executed(example_with("read_schema"), lab, monkeypatch)
    executed(example_with("to_pandas(names"), lab, monkeypatch)
    executed(example_with("open_stability"), lab, monkeypatch)
    executed(example_with("import poppy"), lab, monkeypatch)
    schema, spread, unit, scatter, term, light = capsys.readouterr().out.splitlines()
    assert schema == "µm membrane-table/1"
    assert 0.1 < float(spread) < 10
    assert unit == "µm"
    assert float(scatter) > 0
    defocus_um, height_mm = map(float, term.split())
    assert defocus_um > 1000
    assert 0 < height_mm < 50
    assert 0 < float(light.split()[0]) <= 1


def test_minutes_of_many_mirrors_give_the_figures_of_their_ticks(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(lab / "logs", tmp_path / "here" / "north")
    shutil.copytree(lab / "logs" / NIGHTS[0], tmp_path / "here" / "south" / NIGHTS[0])
    rows = executed(example_with("figures_60s"), tmp_path / "here", monkeypatch)["table"]
    found = {row["mirror"]: row for row in rows.to_dict("records")}
    assert found.keys() == {"north", "south"}
    for mirror, nights in (("north", NIGHTS), ("south", NIGHTS[:1])):
        tables = [
            pq.read_table(path, columns=["state", "error_um"])
            for night in nights
            for path in (lab / "logs" / night / "ticks").glob("*.parquet")
        ]
        ticks = pa.concat_tables(tables).to_pandas()
        # A minute counts by its last state; the minutes in which a hold begins are a small part.
        held = ticks[ticks["state"] == HOLD]["error_um"]
        assert found[mirror]["ticks"] == pytest.approx(len(held), rel=0.15)
        assert found[mirror]["std_um"] == pytest.approx(held.std(ddof=0), rel=0.3)
        assert found[mirror]["change_um"] == 0  # one month


def test_an_object_store_gives_the_ticks_of_report(
    lab: Path, reported: Figures, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = executed(example_with("fsspec.filesystem"), lab, monkeypatch)
    found["store"].rm("/logs", recursive=True)
    assert found["ticks"] == sum(ticks for ticks, _, _ in reported.values())


def test_no_example_is_left_out() -> None:
    assert len(EXAMPLES) == 10
