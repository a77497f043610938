"""Which signal is where, and thumbnails of shared frames."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.telemetry import COLUMN, FIELDS, find_changes, get_column, unpack_rows
from membrane_ctrl.processes.frames import FrameRing, FrameWriter
from membrane_ctrl.recorder.rerun_recording import Recording
from membrane_ctrl.recorder.rerun_shapes import ShapeStreams
from membrane_ctrl.recorder.rerun_telemetry import TelemetryStreams
from membrane_ctrl.recorder.state_lanes import FAULT, STATE
from membrane_ctrl.recorder.thumbnails import THUMBNAIL_INTERVAL_S, Thumbnails
from membrane_ctrl.run_files.plot_marks import MARKS, mark_lines
from membrane_ctrl.run_files.streams import DERIVED, SHAPE_STREAMS, STREAMS, mean_row, overview_um
from tests.support.rrd_reading import scalars
from tests.worlds.synthetic_run import rows_of, shape_of


def test_every_field_is_in_one_stream_and_one_only() -> None:
    found = Counter(line.field for stream in STREAMS for line in stream.lines)
    assert found == Counter(set(FIELDS) - {"mono_s"})


def test_no_two_streams_share_an_entity() -> None:
    paths = [stream.path for stream in (*STREAMS, *DERIVED, *SHAPE_STREAMS, *MARKS)]
    assert len(paths) == len(set(paths))


def test_overview_is_least_mean_and_greatest() -> None:
    rows = unpack_rows([row.pack() for row in rows_of(2.0)])
    errors = [row.error_um for row in rows_of(2.0)]
    assert overview_um(rows)[0] == pytest.approx([min(errors), np.mean(errors), max(errors)])
    assert np.isnan(overview_um(rows * np.nan)).all()


def test_changes_are_found_at_the_edges_too() -> None:
    codes = np.array([4.0, 4.0, 8.0, np.nan, 8.0])
    assert find_changes(codes, 4.0) == [(2, 8), (4, 8)]
    assert find_changes(codes, np.nan) == [(0, 4), (2, 8), (4, 8)]


def test_codes_have_words() -> None:
    assert (STATE.name_code(4), FAULT.name_code(0), FAULT.name_code(20), FAULT.name_code(999)) == (
        "hold",
        "none",
        "over_pressure",
        "code 999",
    )


def test_means_are_of_what_is_there() -> None:
    rows = unpack_rows([row.pack() for row in rows_of(0.1)]).copy()
    rows[:, COLUMN["pump_fraction"]] = [0.1, np.nan, 0.3, np.nan, 0.5]
    mean = mean_row(rows)
    assert get_column(mean, "pump_fraction") == pytest.approx([0.3])
    assert get_column(mean, "mono_s") == pytest.approx([0.04])
    assert np.isnan(get_column(mean, "gas_temperature_c")).all()


@pytest.mark.parametrize("block", [37, 50, 430])
def test_overviews_have_a_point_for_every_second(tmp_path: Path, block: int) -> None:
    rows = unpack_rows([row.pack() for row in rows_of(20.0)])
    recording = Recording(tmp_path, "test", RunClock.start(), Config())
    recording.next_segment()
    telemetry = TelemetryStreams(recording, Config())
    for first in range(0, len(rows), block):
        telemetry.send_rows(rows[first : first + block])
    telemetry.send_waiting()
    recording.close()
    seconds = rows.reshape(20, 50, -1)
    for path, field in (
        ("/overview/loop/error", "error_um"),
        ("/overview/loop/flow", "flow_um_per_s"),
    ):
        time_s, values = scalars(tmp_path / "test-000.rrd", path)
        assert time_s == pytest.approx(np.arange(20) + 0.49), path
        assert values[:, 1] == pytest.approx(seconds[:, :, COLUMN[field]].mean(axis=1)), path
    time_s, variances = scalars(tmp_path / "test-000.rrd", "/loop/band", "Measurements:variances")
    assert (time_s[0], time_s[-1]) == (0.0, pytest.approx(19.98))
    assert variances == pytest.approx(np.full((len(time_s), 1), Config().limits.band_um ** 2))


def test_low_orders_have_the_variances_of_their_cycle(tmp_path: Path) -> None:
    recording = Recording(tmp_path, "test", RunClock.start(), Config())
    recording.next_segment()
    shapes = ShapeStreams(recording)
    first, second = shape_of(0.0, 0), shape_of(2.0, 1)
    for estimate in (first, second):
        shapes.send_estimate(estimate)
    recording.close()
    _, values = scalars(tmp_path / "test-000.rrd", "/shape/change", "Measurements:values")
    _, variances = scalars(tmp_path / "test-000.rrd", "/shape/change", "Measurements:variances")
    assert values[1] == pytest.approx((second.coeffs_um - first.coeffs_um)[3:11])  # Z4 to Z11
    assert variances[1] == pytest.approx(np.diag(second.covariance_um2)[3:11])


def test_lines_are_vertical_and_of_their_kind() -> None:
    events: list[dict[str, Any]] = [
        {"kind": "command", "command": "setpoint", "mono_s": 2.0},
        {"kind": "command", "command": "vent", "mono_s": 3.0, "refused": "not now"},
        {"kind": "command", "command": "resume", "mono_s": 4.0},
        {"kind": "command", "command": "mark", "mono_s": 5.0},
        {"kind": "command", "command": "stop", "mono_s": 6.0},
        {"kind": "fault", "mono_s": 7.0},
        {"kind": "fault", "mono_s": 9.0},
        {"kind": "why", "mono_s": 8.0},
    ]
    timed = [(line["mono_s"], from_dict(line)) for line in events]
    found = {stream.path: (time_s, values[:, 0]) for stream, time_s, values in mark_lines(timed)}
    assert {path: sorted(set(np.round(time_s, 6))) for path, (time_s, _) in found.items()} == {
        "/marks/setpoint": [2.0],
        "/marks/pause": [4.0],
        "/marks/mark": [5.0],
        "/marks/command": [6.0],
        "/marks/fault": [7.0, 9.0],
    }
    time_s, values = found["/marks/fault"]
    assert time_s[0] == time_s[1] < time_s[2] < time_s[3]
    assert values[0] == -values[1] < 0
    assert np.isnan(values[2])  # no line from one fault to the next


def test_changes_of_the_figure_are_against_the_first_since_rebase(tmp_path: Path) -> None:
    recording = Recording(tmp_path, "test", RunClock.start(), Config())
    recording.next_segment()
    shapes = ShapeStreams(recording)
    for cycle in range(4):
        if cycle == 1:
            shapes.set_reference(1.5)
        shapes.send_estimate(
            replace(
                shape_of(float(cycle), cycle), sag_um=100.0 * cycle, displacement_um=7.0 * cycle
            )
        )
    recording.close()
    _, values = scalars(tmp_path / "test-000.rrd", "/shape/sag_change", "Measurements:values")
    _, variances = scalars(tmp_path / "test-000.rrd", "/shape/sag_change", "Measurements:variances")
    assert values[:, 0] == pytest.approx([0.0, 100.0, 0.0, 100.0])
    assert values[:, 1] == pytest.approx([0.0, 7.0, 0.0, 7.0])
    assert variances[:, 0] == pytest.approx(4 * [0.01])


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_thumbnails_come_at_their_interval(dtype: str) -> None:
    ring = FrameRing(4, 512, 600, dtype)
    writer = FrameWriter(ring.address)
    thumbnails = Thumbnails(ring.address)

    def take(pattern: str) -> None:
        slot = writer.begin()
        slot.pixels[:] = np.arange(600)
        slot.commit(pattern, 0.0, 0.0, 0)

    take("x_sin_0")
    made = thumbnails.take_due(0.0)
    take("x_sin_1")
    assert thumbnails.take_due(THUMBNAIL_INTERVAL_S - 1) == []
    take("x_sin_2")
    take("x_sin_3")
    take("y_sin_0")  # x_sin_0 and what was too early ...
    take("y_sin_1")  # ... has been overwritten by now
    made += thumbnails.take_due(THUMBNAIL_INTERVAL_S)
    assert [each.pattern for each in made] == [
        "x_sin_0",
        "x_sin_2",
        "x_sin_3",
        "y_sin_0",
        "y_sin_1",
    ]
    picture = cv2.imdecode(np.frombuffer(made[0].jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (256, 300)
    thumbnails.close()
    writer.close()
    ring.close()
