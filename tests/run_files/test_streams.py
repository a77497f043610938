"""Which signal is where, and thumbnails of shared frames."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.telemetry import FIELDS, changes, unpack
from membrane_ctrl.processes.frames import FrameRing, FrameWriter
from membrane_ctrl.recorder.blueprint import FAULT, STATE
from membrane_ctrl.recorder.process import THUMBNAIL_INTERVAL_S, Thumbnails
from membrane_ctrl.recorder.rerun_streams import ShapeStreams, event_text
from membrane_ctrl.recorder.sink import Recording
from membrane_ctrl.run_files.streams import DERIVED, SHAPE_STREAMS, STREAMS, overview_um
from tests.support.rrd_reading import entities, scalars
from tests.support.synthetic_run import rows_of, shape_of


def test_every_field_is_in_one_stream_and_one_only() -> None:
    found = Counter(line.field for stream in STREAMS for line in stream.lines)
    assert found == Counter(set(FIELDS) - {"mono_s"})


def test_no_two_streams_share_an_entity() -> None:
    paths = [stream.path for stream in (*STREAMS, *DERIVED, *SHAPE_STREAMS)]
    assert len(paths) == len(set(paths))


def test_overview_is_least_mean_and_greatest() -> None:
    rows = unpack([row.pack() for row in rows_of(2.0)])
    errors = [row.error_um for row in rows_of(2.0)]
    assert overview_um(rows)[0] == pytest.approx([min(errors), np.mean(errors), max(errors)])
    assert np.isnan(overview_um(rows * np.nan)).all()


def test_changes_are_found_at_the_edges_too() -> None:
    codes = np.array([4.0, 4.0, 8.0, np.nan, 8.0])
    assert changes(codes, 4.0) == [(2, 8), (4, 8)]
    assert changes(codes, np.nan) == [(0, 4), (2, 8), (4, 8)]


def test_codes_have_words() -> None:
    assert (STATE.word(4), FAULT.word(0), FAULT.word(20), FAULT.word(999)) == (
        "hold",
        "none",
        "over_pressure",
        "code 999",
    )


def test_an_event_is_one_line() -> None:
    event = {"time_utc": "x", "mono_s": 1.0, "kind": "state", "to": "hold", "error_um": 1 / 3, "why": None}
    assert event_text(event) == "state: to hold, error_um 0.333333"
    assert event_text({"kind": "end"}) == "end"


def test_changes_of_the_figure_are_against_the_first_since_rebase(tmp_path: Path) -> None:
    recording = Recording(tmp_path, "test", RunClock.start(), Config())
    recording.next_segment()
    shapes = ShapeStreams(recording)
    for cycle in range(4):
        if cycle == 1:
            shapes.rebase(1.5)
        shapes.send(replace(shape_of(float(cycle), cycle), sag_um=100.0 * cycle))
    recording.close()
    _, values = scalars(tmp_path / "test-000.rrd", "/shape/sag_change")
    assert values[:, 0] == pytest.approx([0.0, 100.0, 0.0, 100.0])


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_thumbnails_come_at_their_interval(tmp_path: Path, dtype: str) -> None:
    ring = FrameRing(4, 512, 600, dtype)
    writer = FrameWriter(ring.address)
    recording = Recording(tmp_path, "test", RunClock.start(), Config())
    recording.next_segment()
    thumbnails = Thumbnails(recording, ring.address)

    def take(pattern: str) -> None:
        slot = writer.begin()
        slot.pixels[:] = np.arange(600)
        slot.commit(pattern, 0.0, 0.0, 0)

    take("x_sin_0")
    thumbnails.send(0.0)
    take("x_sin_1")
    thumbnails.send(THUMBNAIL_INTERVAL_S - 1)  # too early
    take("x_sin_2")
    take("x_sin_3")
    take("y_sin_0")  # x_sin_0 and what was too early ...
    take("y_sin_1")  # ... has been overwritten by now
    thumbnails.send(THUMBNAIL_INTERVAL_S)
    recording.close()
    frames = {path for path in entities(tmp_path / "test-000.rrd") if path.startswith("/frames/")}
    assert frames == {f"/frames/{name}" for name in ("x_sin_0", "x_sin_2", "x_sin_3", "y_sin_0", "y_sin_1")}
    thumbnails.close()
    writer.close()
    ring.close()
