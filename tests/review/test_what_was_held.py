"""The figures of a hold are those of the settled hold; the rest is reported beside them, everywhere
the same.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.cli import run as command
from membrane_ctrl.model import file_checksums
from membrane_ctrl.model.telemetry import Rows, get_columns, unpack_rows
from membrane_ctrl.review import open_run
from membrane_ctrl.review.catalogue import read_entry
from membrane_ctrl.review.report.json import report_table
from membrane_ctrl.review.statistics.analysis import analyse_run
from membrane_ctrl.run_files.hold_parts import HoldParts
from membrane_ctrl.run_files.summary import Summary
from tests.support.scenario import CheckedScenario, play
from tests.worlds.nights import write_run

RATE_HZ = 10.0


@pytest.fixture(scope="module")
def rows() -> Rows:
    """A move, a pause in which the mirror strays by 40 µm, and eight seconds without light."""
    at = [
        {"time_s": 60.0, "command": "setpoint", "value": 40.0},
        {"time_s": 160.0, "command": "pause"},
        {"time_s": 161.0, "event": "leak", "value": 1.8},
        {"time_s": 200.0, "command": "resume"},
        {"time_s": 320.0, "wrong": "no_light", "for_s": 8.0},
    ]
    about = {
        "title": "held",
        "duration_s": 420.0,
        "config": {"loop": {"rate_hz": RATE_HZ}},
        "at": at,
        "expect": {},
    }
    return unpack_rows(
        [tick.row.pack() for tick in play(CheckedScenario.model_validate(about)).ticks]
    )


@pytest.fixture(scope="module")
def folder(rows: Rows, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("held") / "20261121T180000Z-held"
    write_run(run, iter([(rows, [])]))
    config = open_run(run).config
    summary = Summary.for_config(config)
    for first in range(0, len(rows), 33):
        summary.add_rows(rows[first : first + 33])
    (run / "summary.json").write_text(file_checksums.dumps_checked(summary.as_dict({}, {})))
    return run


@pytest.mark.parametrize("batch", [1, 7, 100, 10_000])
def test_the_parts_do_not_depend_on_the_blocks(rows: Rows, batch: int) -> None:
    parts = HoldParts(2.0)
    blocks = [
        parts.classify_block(get_columns(rows[first : first + batch]))
        for first in range(0, len(rows), batch)
    ]
    found = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    assert np.sum([*found.values()], axis=0).max() == 1
    time_s = get_columns(rows)["mono_s"]
    assert time_s[found["paused"]][[0, -1]] == pytest.approx([160.1, 200.0], abs=0.2)
    assert time_s[found["faults"]][[0, -1]] == pytest.approx([320.3, 328.5], abs=1.0)
    assert not found["held"][(time_s > 60.2) & (time_s < 70.0)].any()
    strayed = np.flatnonzero(found["moving"] & (time_s > 200.1) & (time_s < 300.0))
    assert np.abs(get_columns(rows)["error_um"][strayed[0]]) > 20.0
    assert time_s[strayed[-1]] - time_s[strayed[0]] > 10.0
    assert found["held"][time_s > 345.0].mean() > 0.9


def test_every_place_states_the_same_quality(
    folder: Path, rows: Rows, capsys: pytest.CaptureFixture[str]
) -> None:
    report = report_table(analyse_run(open_run(folder)))
    listed = read_entry(folder)
    window = report["true"]["windows"][0]
    assert window["std_um"] < 0.5
    assert (listed.std_um, listed.in_band) == pytest.approx(
        (window["std_um"], window["in_band"]), rel=1e-4
    )
    times_s = (listed.held_s, listed.faults_s, listed.paused_s, listed.moving_s)
    assert times_s == pytest.approx(
        [report[f"{name}_s"] for name in ("settled", "faults", "paused", "moving")], abs=1.0
    )
    assert "paused 40 s (9." in report["sentence"]
    assert command(["runs", "show", str(folder)]) == 0
    shown = capsys.readouterr().out
    assert "not counted as held: faults " in shown
    assert "paused 40 s" in shown
    assert [odd["seen"][:4] for odd in report["anomalies"] if odd["name"] == "paused"] == ["40 s"]


def test_a_summary_of_no_length_is_shown(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / folder.name
    shutil.copytree(folder, run)
    (run / "summary.json").write_text(
        '{"schema": "membrane-summary/2", "duration_s": 0, "held": {"faults_s": 5}}'
    )
    assert command(["runs", "show", str(run)]) == 0
    assert "faults 5 s (100 %)" in capsys.readouterr().out


def test_a_summary_of_another_schema_gives_no_figures(folder: Path) -> None:
    (folder / "summary.json").write_text('{"schema": "membrane-summary/0", "true_std_um": 2.24}')
    assert np.isnan(read_entry(folder).std_um)
