"""The recording's text about a cycle."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.recorder.rerun_recording import Recording
from membrane_ctrl.recorder.rerun_shapes import ShapeStreams, _make_legend
from tests.support.rrd_reading import scalars, strings
from tests.worlds.synthetic_run import shape_of


def test_both_error_bars_of_the_sag_are_distinguished() -> None:
    shape = shape_of(1.0, 3)
    assert "± 0.100 µm in a change\n" in _make_legend(
        shape, shape, {}
    )  # nothing is stated of what they share
    assert "± 0.100 µm in a change, ± 21.8 µm shared by all cycles\n" in _make_legend(
        replace(shape, geometry_sag_sigma_um=21.84), shape, {}
    )


def test_colours_of_changes_are_around_zero_and_those_of_others_from_it(tmp_path: Path) -> None:
    recording = Recording(tmp_path, "test", RunClock.start(), Config())
    recording.next_segment()
    shapes = ShapeStreams(recording)
    for cycle, tilt_um in enumerate((0.0, 5.0)):
        first = shape_of(0.0, 0)
        coeffs_um = first.coeffs_um + tilt_um * (np.arange(ZERNIKE_TERMS) == 1)
        shapes.send_estimate(replace(first, time_s=700.0 * cycle, cycle=cycle, coeffs_um=coeffs_um))
    recording.close()
    path = tmp_path / "test-000.rrd"

    def span(kind: str) -> list[float]:
        return list(scalars(path, f"/shape/map/{kind}", "DepthImage:depth_range")[1][-1, 0])

    low, high = span("difference")
    assert 9.0 < high == -low < 10.0  # a tilt of 5 µm RMS is 10 µm at the rim
    assert span("difference_no_tilt") == [
        -0.5,
        0.5,
    ]  # nothing left: noise must not fill the colours
    assert span("difference_no_defocus") == pytest.approx([-0.1, 0.1])
    assert span("scatter") == pytest.approx([0.0, high / np.sqrt(2)], rel=1e-3)
    assert span("height")[0] == span("uncertainty")[0] == 0.0
    legend = strings(path, "/shape/legend", "TextDocument:text")[-1][1]
    assert f"| change | ±{high:.3g} µm |" in legend


def test_of_twenty_frames_a_second_the_timeline_has_one_and_every_change_of_verdict(
    tmp_path: Path,
) -> None:
    recording = Recording(tmp_path, "test", RunClock.start(), Config())
    recording.next_segment()
    streams = ShapeStreams(recording)
    first = shape_of(0.0, 0)
    for k in range(200):
        lost = 105 <= k < 110
        coeffs_um = first.coeffs_um + 0.3 * (np.arange(ZERNIKE_TERMS) == 11) * (k >= 100)
        verdict = "rejected" if lost else "ok"
        streams.send_estimate(
            replace(first, time_s=k / 20, kind="track", coeffs_um=coeffs_um, verdict=verdict)
        )
    recording.close()
    path = tmp_path / "test-000.rrd"
    times = scalars(path, "/shape/residual", "Scalars:scalars")[0]
    assert 11 <= len(times) <= 14
    assert [state for _, state in strings(path, "/state/verdict", "StateChange:state")] == [
        "ok",
        "rejected",
        "ok",
    ]
    span = scalars(path, "/shape/waterfall", "DepthImage:depth_range")[1]
    assert span[0, 0].tolist() == pytest.approx([-0.05, 0.05])
    assert span[-1, 0].tolist() == pytest.approx([-0.3, 0.3], rel=1e-3)
