"""What single ticks say: blind ticks, parts, thinned ticks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.nights import night, write_run
from membrane_ctrl.recording.rows import COLUMN, column
from membrane_ctrl.review import open_run
from membrane_ctrl.review.analysis import analyse
from membrane_ctrl.review.report_json import report_table
from membrane_ctrl.review.verdict import verdict

HOURS = 0.1


def test_the_true_centre_counts_where_the_laser_is_blind(tmp_path: Path) -> None:
    rows, shapes = night(1, HOURS, "typical", [])
    blind = (column(rows, "mono_s") >= 100) & (column(rows, "mono_s") < 160)
    rows[:, COLUMN["truth_displacement_um"]] = np.where(blind, -3.0, 0.1)
    rows[blind, COLUMN["displacement_um"]] = np.nan
    write_run(tmp_path / "run", iter([(rows, shapes)]))
    analysis = analyse(open_run(tmp_path / "run"))
    assert analysis.reading is not None
    assert analysis.true is not None
    seconds, minutes = analysis.true.windows[0], analysis.true.windows[2]
    assert analysis.reading.windows[0].count == pytest.approx(seconds.count - 60, abs=2)
    assert seconds.in_band == pytest.approx(1 - 60 / seconds.count, abs=2 / seconds.count)
    assert minutes.max_um > 1.0
    # a flow that is fed forward while the laser is blind counts, too
    assert analysis.benefit is not None
    assert analysis.benefit.with_um == pytest.approx(seconds.std_um, rel=1e-9)
    assert report_table(analysis)["held_without_reading_s"] == pytest.approx(60, abs=0.2)
    assert "(1 min of it without a reading)" in verdict(analysis)[1]
