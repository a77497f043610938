"""The review's tabs in the headless viewer and the report in headless Chromium,
from a fresh run.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from membrane_ctrl.cli import run as command
from membrane_ctrl.review.viewer.blueprints import TABS
from tests.support.machine_needs import needs, program_path
from tests.support.review_runs import written
from tests.worlds.nights import Planted

ERROR_BLUE = (86, 180, 233)


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    events = [Planted("pressure step", 300.5, 20.0), Planted("laser lost", 700.0, 3.0)]
    return written(tmp_path_factory.mktemp("pictures"), 0.3, events)


def share_near(picture: Path, colour: tuple[int, int, int]) -> float:
    """Share of pixels within 25 levels of a colour (red, green, blue)."""
    pixels = cv2.imdecode(np.frombuffer(picture.read_bytes(), np.uint8), cv2.IMREAD_COLOR)[
        ..., ::-1
    ].astype(int)
    return float((np.abs(pixels - colour).max(axis=2) <= 25).mean())


@pytest.mark.viewer
@needs("vulkan")
@pytest.mark.parametrize(
    "tab",
    [
        "overview",
        *(pytest.param(tab, marks=pytest.mark.campaign) for tab in TABS if tab != "overview"),
    ],
)
def test_a_tab_shows_its_plots(run_dir: Path, tmp_path: Path, tab: str) -> None:
    picture = tmp_path / "tab.png"
    assert command(["review", str(run_dir), "--tab", tab, "--screenshot", str(picture)]) == 0
    assert share_near(picture, ERROR_BLUE) > 0.0005


@pytest.mark.viewer
@needs("chromium")
def test_the_report_is_drawn_by_a_browser(run_dir: Path, tmp_path: Path) -> None:
    assert command(["report", str(run_dir), "--out", str(tmp_path)]) == 0
    picture = tmp_path / "report.png"
    options = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-sync",
        "--disable-background-networking",
        "--disable-component-update",
        "--window-size=1150,3600",
        f"--user-data-dir={tmp_path / 'profile'}",
        f"--screenshot={picture}",
    ]
    page = (tmp_path / "report.html").as_uri()
    subprocess.run(
        [program_path("chromium"), *options, page], check=True, capture_output=True, timeout=60
    )
    assert share_near(picture, (0, 158, 115)) > 0.005  # the lane of hold
    assert share_near(picture, (0, 114, 178)) > 0.003  # the blue of every plot
