"""Figures of single ticks: blind ticks, parts, missed ticks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.model.telemetry import COLUMN, get_column
from membrane_ctrl.review import open_run
from membrane_ctrl.review.report.json import make_verdict, report_table
from membrane_ctrl.review.statistics.analysis import analyse_run
from membrane_ctrl.review.statistics.held_time import HeldTime
from tests.worlds.nights import CONFIG, night, write_run

HOURS = 0.1


def test_the_true_centre_counts_where_the_laser_is_blind(tmp_path: Path) -> None:
    rows, shapes = night(1, HOURS, "typical", [])
    blind = (get_column(rows, "mono_s") >= 100) & (get_column(rows, "mono_s") < 160)
    rows[:, COLUMN["truth_displacement_um"]] = np.where(blind, -3.0, 0.1)
    rows[blind, COLUMN["displacement_um"]] = np.nan
    write_run(tmp_path / "run", iter([(rows, shapes)]))
    analysis = analyse_run(open_run(tmp_path / "run"))
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
    assert "(1 min of it without a reading)" in make_verdict(analysis)[1]


def test_ticks_that_were_missed_are_left_out(tmp_path: Path) -> None:
    rows, _ = night(1, HOURS, "typical", [])
    there = ~np.isin(get_column(rows, "tick"), [1203, 1204, 1205])
    write_run(tmp_path / "run", iter([(rows[there], [])]))
    analysis = analyse_run(open_run(tmp_path / "run"), 60.5, 140.3)
    assert analysis.benefit is not None
    assert analysis.ticks.hold_s == pytest.approx(79.8, abs=0.1)


def test_a_moving_setpoint_does_not_count_as_held(tmp_path: Path) -> None:
    rows, _ = night(1, HOURS, "quiet", [])
    time_s = get_column(rows, "mono_s")
    rows[:, COLUMN["setpoint_um"]] = np.interp(time_s, [100, 190], [-90.0, 0.0])
    rows[:, COLUMN["target_um"]] = np.where(time_s < 100, -90.0, 0.0)
    write_run(tmp_path / "run", iter([(rows, [])]))
    analysis = analyse_run(open_run(tmp_path / "run"))
    assert analysis.ticks.hold_s == pytest.approx(360, abs=0.5)
    assert analysis.ticks.settled_s == pytest.approx(360 - 90 - 5 - 5, abs=0.5)
    assert report_table(analysis)["settled_s"] == analysis.ticks.settled_s
    assert (
        "Held for 4 min 20 s of 6 min (moving or settling 1 min 40 s (27.8 %))"
        in make_verdict(analysis)[1]
    )


def test_a_tick_just_behind_its_second_belongs_to_it(tmp_path: Path) -> None:
    rows, _ = night(1, HOURS, "quiet", [])
    late_ms = np.random.default_rng(1).uniform(0.0, 1.0, len(rows))
    rows[:, COLUMN["mono_s"]] = 0.2 * (1 + np.arange(len(rows))) + 1e-3 * late_ms - 5e-4  # 5 Hz
    rows[:, COLUMN["lateness_ms"]], rows[:, COLUMN["dt_s"]] = late_ms, 0.2
    write_run(tmp_path / "run", iter([(rows, [])]))
    analysis = analyse_run(open_run(tmp_path / "run"))
    assert analysis.reading is not None
    assert analysis.reading.windows[0].count == pytest.approx(2 * HOURS * 3600 - 5, abs=1)


def test_time_held_is_that_between_ticks() -> None:
    time_s = np.array([0.0, 0.1, 0.6, 1.1, 1.2, 3.0, 63.0, 63.1])
    held = np.array([False, True, True, True, False, True, True, True])
    for cut in (1, 3, 5, 7):
        time = HeldTime()
        time.add_times(time_s[:cut], held[:cut])
        time.add_times(time_s[:0], held[:0])
        time.add_times(time_s[cut:], held[cut:])
        # the minute without a tick is not known
        assert time.result_s(0.1) == pytest.approx(0.5 + 0.5 + 0.1 + 0.1 + 0.1)


def test_a_flow_that_only_lags_is_not_at_a_limit(tmp_path: Path) -> None:
    rows, _ = night(1, HOURS, "quiet", [])
    rows[:, COLUMN["flow_wanted_um_per_s"]] = 1.0
    rows[:, COLUMN["flow_um_per_s"]] = 0.9  # the limit of its rate
    rows[::4, COLUMN["flow_wanted_um_per_s"]] = -0.1
    rows[1::4, COLUMN["flow_wanted_um_per_s"]] = CONFIG.loop.flow_max_um_per_s + 0.1
    write_run(tmp_path / "run", iter([(rows, [])]))
    assert analyse_run(open_run(tmp_path / "run")).ticks.pump.saturated_share == pytest.approx(
        0.5, abs=1e-3
    )


def test_the_limit_of_the_flow_is_that_of_the_curve_in_force(tmp_path: Path) -> None:
    """A curve of 10 µm/s from a third of the run to two thirds; gains change meanwhile."""
    rows, _ = night(1, HOURS, "quiet", [])
    rows[:, COLUMN["flow_wanted_um_per_s"]] = 8.0
    write_run(tmp_path / "run", iter([(rows, [])]))
    third_s = float(rows[-1, COLUMN["mono_s"]]) / 3
    curve = {"curve_fraction": [0.1, 1.0], "curve_um_per_s": [0.0, 10.0]}
    asked = {
        "kind": "command",
        "command": "gains",
        "who": "tom",
        "why": "",
        "value": 1e4,
        "refused": None,
    }
    loop = CONFIG.loop.model_dump() | {"flow_max_um_per_s": 10.0}
    reports = [
        asked | {"mono_s": third_s, "loop": loop | {"pump": curve}},
        asked | {"mono_s": 1.5 * third_s, "loop": loop | {"kp_per_s": 0.5}},
        asked | {"mono_s": 1.6 * third_s, "loop": "damaged"},
        {"kind": "gains_reverted", "why": "nobody kept them", "mono_s": 2 * third_s},
    ]
    with (tmp_path / "run/events.jsonl").open("a") as log:
        log.writelines(
            json.dumps({"time_utc": "2026-11-21T18:00:00+00:00", **event}) + "\n"
            for event in reports
        )
    assert analyse_run(open_run(tmp_path / "run")).ticks.pump.saturated_share == pytest.approx(
        2 / 3, abs=1e-2
    )
