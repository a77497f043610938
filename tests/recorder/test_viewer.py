"""The recording opens in the viewer with its layout; needs the headless viewer."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.telemetry import unpack_rows
from membrane_ctrl.recorder.rerun_events import send_events
from membrane_ctrl.recorder.rerun_recording import Recording
from membrane_ctrl.recorder.rerun_shapes import ShapeStreams
from membrane_ctrl.recorder.rerun_telemetry import TelemetryStreams
from tests.support.machine_needs import needs
from tests.support.recording_picture import screenshot
from tests.worlds.synthetic_run import rows_of, shape_of

pytestmark = [pytest.mark.viewer, needs("vulkan")]

# Colours of the plots as the viewer draws them (red, green, blue).
ERROR_BLUE = (86, 180, 233)
HOLD_GREEN = (0, 127, 92)


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    recording = Recording(tmp_path, "test", RunClock.start(), Config())
    recording.next_segment()
    TelemetryStreams(recording, Config()).send_rows(
        unpack_rows([row.pack() for row in rows_of(30.0)])
    )
    send_events(recording, [{"kind": "state", "mono_s": 6.0, "to": "hold"}])
    shapes = ShapeStreams(recording)
    for cycle in range(10):
        shapes.send_estimate(shape_of(3.0 * cycle, cycle))
    recording.close()
    return tmp_path


def share_near(png: bytes, colour: tuple[int, int, int]) -> float:
    """Share of pixels within 25 levels of a colour."""
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    return float((np.abs(picture - colour).max(axis=2) <= 25).mean())


@pytest.mark.campaign
def test_overview_shows_the_error_and_the_states(run_dir: Path) -> None:
    png = screenshot(run_dir)
    assert share_near(png, ERROR_BLUE) > 0.0005
    assert share_near(png, HOLD_GREEN) > 0.005


def test_shape_tab_shows_maps_in_colour(run_dir: Path) -> None:
    picture = cv2.imdecode(
        np.frombuffer(screenshot(run_dir, "Shape"), np.uint8), cv2.IMREAD_COLOR
    ).astype(int)
    colourful = (picture.max(axis=2) - picture.min(axis=2)) > 100
    top = colourful[: picture.shape[0] * 2 // 5]
    assert top.mean() > 0.15  # three maps fill much of the upper part
