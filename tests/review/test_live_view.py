"""The live view: what the tables of a run in progress get is in the viewer's recording, once."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.telemetry import Rows, get_column, unpack_rows
from membrane_ctrl.recorder.handover import RecorderState, save_state
from membrane_ctrl.recorder.rerun_recording import Recording
from membrane_ctrl.review import open_run
from membrane_ctrl.review.viewer.live_view import LOOK_S, RECENT_S, LiveView, follow_run
from membrane_ctrl.run_files.run_folder import create_run_folder
from membrane_ctrl.run_files.run_tables import RunTables
from membrane_ctrl.run_files.summary import Summary
from tests.support.rrd_reading import entities, scalars, strings
from tests.worlds.nights import CONFIG, batch_of
from tests.worlds.synthetic_run import STARTED_UTC, rows_of, shape_of

ROWS: Rows = unpack_rows([row.pack() for row in rows_of(12.0)])
HOLD = {"mono_s": 6.0, "kind": "state", "state": "hold", "from": "settle", "why": ""}


class LiveRun:
    """A run whose recorder writes tables, and a view that a file takes instead of a viewer."""

    def __init__(self, folder: Path) -> None:
        self.folder = create_run_folder(folder, "night", STARTED_UTC, CONFIG)
        self.tables = RunTables(self.folder, STARTED_UTC)
        self.out = folder / "view"
        self.out.mkdir()

    def second(self, number: int) -> None:
        self.tables.add_ticks(batch_of(ROWS[50 * number : 50 * number + 50]))
        self.tables.add_shape(shape_of(float(number), number))
        self.tables.sync_tables()

    def view(self) -> LiveView:
        recording = Recording(self.out, "view", RunClock(0.0, STARTED_UTC), CONFIG)
        return LiveView(open_run(self.folder), recording)

    @property
    def file(self) -> Path:
        return self.out / "view-000.rrd"


@pytest.fixture
def run(tmp_path: Path) -> LiveRun:
    return LiveRun(tmp_path)


def test_the_view_has_every_row_of_a_growing_run_once(run: LiveRun) -> None:
    for number in range(4):
        run.second(number)
    view = run.view()
    assert view.send_new()
    assert not view.send_new()
    run.tables.add_events([HOLD])
    run.tables.add_thumbnail(4.5, "crossed", b"\xff\xd8jpeg")
    for number in range(4, 12):
        run.second(number)
        assert view.send_new()
    view.send_waiting()
    time_s, error_um = scalars(run.file, "/loop/error")
    assert np.allclose(time_s, get_column(ROWS, "mono_s"))
    assert np.allclose(error_um[:, 0], get_column(ROWS, "error_um"), rtol=1e-6)
    assert len(scalars(run.file, "/shape/zernike")[0]) == 12
    assert "/frames/crossed" in entities(run.file)
    ((at_s, text),) = strings(run.file, "/events", "TextLog:text")
    assert at_s == 6.0
    assert "hold" in text


def test_the_run_itself_is_not_changed(run: LiveRun) -> None:
    run.second(0)
    before = sorted(path.relative_to(run.folder) for path in run.folder.rglob("*"))
    view = run.view()
    view.send_new()
    view.send_waiting()
    assert sorted(path.relative_to(run.folder) for path in run.folder.rglob("*")) == before


def test_the_page_has_the_figures_that_the_recorder_handed_on(run: LiveRun) -> None:
    run.second(0)
    summary = Summary.for_config(CONFIG)
    summary.add_rows(ROWS)
    save_state(run.folder, RecorderState(summary))
    view = run.view()
    view.send_new()
    view.send_waiting()
    ((_, page),) = strings(run.file, "/summary", "TextDocument:text")
    assert page.startswith("| hold |")
    assert f"of {len(ROWS)}" in page


def test_a_long_run_begins_some_minutes_back(run: LiveRun, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("membrane_ctrl.review.viewer.live_view.RECENT_S", 3.0)
    for number in range(12):
        run.second(number)
    view = run.view()
    view.send_new()
    view.send_waiting()
    assert RECENT_S > 60.0
    time_s, _ = scalars(run.file, "/loop/error")
    assert time_s[0] == pytest.approx(get_column(ROWS, "mono_s")[-1] - 3.0, abs=0.05)


def test_damaged_rows_are_left_out(run: LiveRun) -> None:
    run.second(0)
    run.tables.add_events([HOLD])
    run.second(1)
    for journal in run.folder.glob("events/*.journal"):
        data = bytearray(journal.read_bytes())
        data[-5] ^= 255
        journal.write_bytes(data)
    view = run.view()
    assert view.send_new()
    view.send_waiting()
    assert len(scalars(run.file, "/loop/error")[0]) == 100


def test_it_follows_until_the_run_is_over(run: LiveRun) -> None:
    run.second(0)
    seconds = iter(range(1, 6))
    waits = []

    def wait(time_s: float) -> None:
        waits.append(time_s)
        number = next(seconds, None)
        if number is None:
            (run.folder / "summary.json").write_text(json.dumps({}))
        else:
            run.second(number)

    follow_run(run.view(), run.folder, lambda: True, wait)
    assert set(waits) == {LOOK_S}
    assert len(scalars(run.file, "/loop/error")[0]) == 300


def test_it_ends_with_the_viewer(run: LiveRun) -> None:
    run.second(0)
    left = iter((True, True, False))
    follow_run(run.view(), run.folder, lambda: next(left), lambda _: None)
