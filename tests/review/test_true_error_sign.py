"""The error of the true centre has one sign, that of `error_um` (setpoint minus value), wherever it
is shown.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.hold.closing_words import _list_headlines
from membrane_ctrl.model.telemetry import COLUMN, Rows, get_columns, true_error_um
from membrane_ctrl.review import open_run
from membrane_ctrl.review.report.json import make_verdict, report_table
from membrane_ctrl.review.statistics.analysis import analyse_run
from membrane_ctrl.run_files.summary import Summary
from tests.support.review_runs import segment
from tests.support.rrd_reading import scalars
from tests.worlds.nights import CONFIG, night, write_run

SHALLOW_UM = 0.75  # the bowl is so much less deep than it should be


@pytest.fixture
def rows() -> Rows:
    made, _ = night(1, 0.1, "typical", [])
    wander_um = made[:, COLUMN["truth_displacement_um"]] - made[:, COLUMN["target_um"]]
    made[:, COLUMN["truth_displacement_um"]] += -SHALLOW_UM - wander_um.mean()
    return made


def test_every_place_shows_the_same_sign(tmp_path: Path, rows: Rows) -> None:
    assert true_error_um(get_columns(rows)).mean() == pytest.approx(SHALLOW_UM)
    summary = Summary.for_config(CONFIG)
    summary.add_rows(rows)
    table = summary.as_dict({}, {})
    folder = tmp_path / "20261121T180000Z-shallow"
    write_run(folder, iter([(rows, [])]))
    run = open_run(folder)
    analysis = analyse_run(run)
    report = report_table(analysis)
    _, recorded = scalars(segment(folder, rows), "/truth/error")
    shown = {
        "summary.json": table["true_bias_um"],
        "summary.json, first second": table["sag_error_um"]["start"],
        "report.json": report["true"]["windows"][0]["mean_um"],
        "plots and the viewer": float(np.nanmean(run.level(10.0)["mean_true_error_um"])),
        "Rerun": float(recorded.mean()),
    }
    assert all(value == pytest.approx(SHALLOW_UM, abs=0.2) for value in shown.values()), shown
    stated = f"mean error {report['true']['windows'][0]['mean_um']:+.3f} µm"
    assert stated in make_verdict(analysis)[1]
    assert any(line.endswith(stated) for line in _list_headlines(table))
