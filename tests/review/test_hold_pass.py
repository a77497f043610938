"""Figures of single ticks: blind ticks, parts, thinned ticks."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.model.telemetry import COLUMN, Rows, State, column
from membrane_ctrl.review import open_run
from membrane_ctrl.review.report.json import report_table, verdict
from membrane_ctrl.review.statistics.analysis import analyse
from membrane_ctrl.review.statistics.spectra import HeldTime
from tests.worlds.nights import CONFIG, night, write_run

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


def _with_ticks(folder: Path, rows: Rows, kept: np.ndarray) -> Path:
    """A run whose levels are of all rows, and its ticks some of them."""
    write_run(folder, iter([(rows, [])]))
    write_run(folder / "thin", iter([(rows[kept], [])]))
    shutil.copytree(folder / "thin" / "ticks", folder / "ticks", dirs_exist_ok=True)
    return folder


def test_seconds_without_every_tick_are_those_of_the_level(tmp_path: Path) -> None:
    rows, _ = night(1, HOURS, "typical", [])
    rows[:300, COLUMN["state"]] = State.SETTLE
    # something happened: ten seconds with every tick
    rows[1000:1050, COLUMN["displacement_um"]] += 1.0
    tick = column(rows, "tick")
    some = (tick % 5 == 0) | ((tick >= 950) & (tick < 1050))
    every = analyse(open_run(_with_ticks(tmp_path / "every", rows, tick >= 0)))
    thinned = analyse(open_run(_with_ticks(tmp_path / "some", rows, some)))
    assert every.ticks.thin_s == 0
    assert thinned.ticks.hold_s == pytest.approx(every.ticks.hold_s, abs=0.5)
    assert thinned.ticks.thin_s == pytest.approx(HOURS * 3600 - 30 - 5 - 10, abs=2)
    assert every.reading is not None
    assert thinned.reading is not None
    for ours, theirs in zip(thinned.reading.windows, every.reading.windows, strict=True):
        assert ours.count == theirs.count
        assert ours.std_um == pytest.approx(theirs.std_um, rel=1e-3)
        assert ours.mean_um == pytest.approx(theirs.mean_um, abs=1e-4)
    assert [odd.name for odd in thinned.anomalies if odd not in every.anomalies] == [
        "thinned ticks"
    ]
    assert every.benefit is not None
    assert thinned.benefit is None
    for path in (tmp_path / "some").glob("ticks_*"):
        shutil.rmtree(path)
    bare = analyse(open_run(tmp_path / "some"))
    assert bare.ticks.uncovered_s == pytest.approx(thinned.ticks.thin_s, abs=2)
    assert any("held not counted" in odd.seen for odd in bare.anomalies)


def test_a_part_between_seconds_and_a_lost_tick_are_not_thin(tmp_path: Path) -> None:
    rows, _ = night(1, HOURS, "typical", [])
    run = open_run(
        _with_ticks(tmp_path / "run", rows, ~np.isin(column(rows, "tick"), [1203, 1204, 1205]))
    )
    analysis = analyse(run, 60.5, 140.3)
    assert (analysis.ticks.thin_s, analysis.benefit is None) == (0, False)
    assert analysis.ticks.hold_s == pytest.approx(79.8, abs=0.1)


def test_a_setpoint_on_its_way_is_told_from_what_counts(tmp_path: Path) -> None:
    rows, _ = night(1, HOURS, "quiet", [])
    time_s = column(rows, "mono_s")
    rows[:, COLUMN["setpoint_um"]] = np.interp(time_s, [100, 190], [-90.0, 0.0])
    rows[:, COLUMN["target_um"]] = np.where(time_s < 100, -90.0, 0.0)
    write_run(tmp_path / "run", iter([(rows, [])]))
    analysis = analyse(open_run(tmp_path / "run"))
    assert analysis.ticks.hold_s == pytest.approx(360, abs=0.5)
    assert analysis.ticks.settled_s == pytest.approx(360 - 90 - 5 - 5, abs=0.5)
    assert report_table(analysis)["settled_s"] == analysis.ticks.settled_s
    assert (
        "Held for 4 min 20 s of 6 min (moving or settling 1 min 40 s (27.8 %))"
        in verdict(analysis)[1]
    )


def test_a_tick_that_comes_just_behind_its_second_thins_none(tmp_path: Path) -> None:
    rows, _ = night(1, HOURS, "quiet", [])
    late_ms = np.random.default_rng(1).uniform(0.0, 1.0, len(rows))
    rows[:, COLUMN["mono_s"]] = 0.2 * (1 + np.arange(len(rows))) + 1e-3 * late_ms - 5e-4  # 5 Hz
    rows[:, COLUMN["lateness_ms"]], rows[:, COLUMN["dt_s"]] = late_ms, 0.2
    write_run(tmp_path / "run", iter([(rows, [])]))
    analysis = analyse(open_run(tmp_path / "run"))
    assert analysis.reading is not None
    assert analysis.reading.windows[0].count == pytest.approx(2 * HOURS * 3600 - 5, abs=1)
    assert (analysis.ticks.thin_s, analysis.ticks.uncovered_s) == (0.0, 0.0)


def test_time_held_is_that_between_ticks() -> None:
    time_s = np.array([0.0, 0.1, 0.6, 1.1, 1.2, 3.0, 63.0, 63.1])
    held = np.array([False, True, True, True, False, True, True, True])
    for cut in (1, 3, 5, 7):
        time = HeldTime(quiet_hz=2.0)
        time.add(time_s[:cut], held[:cut])
        time.add(time_s[:0], held[:0])
        time.add(time_s[cut:], held[cut:])
        # the minute without a tick is not known
        assert time.result_s(0.1) == pytest.approx(0.5 + 0.5 + 0.1 + 0.1 + 0.1)


def test_a_flow_that_only_lags_is_not_at_a_limit(tmp_path: Path) -> None:
    rows, _ = night(1, HOURS, "quiet", [])
    rows[:, COLUMN["flow_wanted_um_per_s"]] = 1.0
    rows[:, COLUMN["flow_um_per_s"]] = 0.9  # the limit of its rate
    rows[::4, COLUMN["flow_wanted_um_per_s"]] = -0.1
    rows[1::4, COLUMN["flow_wanted_um_per_s"]] = CONFIG.loop.flow_max_um_per_s + 0.1
    write_run(tmp_path / "run", iter([(rows, [])]))
    assert analyse(open_run(tmp_path / "run")).ticks.pump.saturated_share == pytest.approx(
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
    told = [
        asked | {"mono_s": third_s, "loop": loop | {"pump": curve}},
        asked | {"mono_s": 1.5 * third_s, "loop": loop | {"kp_per_s": 0.5}},
        asked | {"mono_s": 1.6 * third_s, "loop": "damaged"},
        {"kind": "gains_reverted", "why": "nobody kept them", "mono_s": 2 * third_s},
    ]
    with (tmp_path / "run/events.jsonl").open("a") as log:
        log.writelines(
            json.dumps({"time_utc": "2026-11-21T18:00:00+00:00", **event}) + "\n" for event in told
        )
    assert analyse(open_run(tmp_path / "run")).ticks.pump.saturated_share == pytest.approx(
        2 / 3, abs=1e-2
    )
