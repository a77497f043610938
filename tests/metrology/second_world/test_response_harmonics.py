"""A frame that is left out of four, and a panel with a gamma: the cause of the slopes is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.studies.second_world_budget import STILL
from tests.studies.second_world_errors import MeasuredErrors, drawn_points_mm, measured_errors
from tests.worlds.second_optics import Bench, Mirror, Panel, Sensor, Stated, World

EIGHTH = 0.125
STALE_FRAME = 3  # the last step along x


@pytest.mark.parametrize(
    ("gamma", "focal_relative", "is_response", "is_geometry"),
    [(2.0, 0.0, True, False), (1.0, 0.02, False, True), (2.0, 0.03, True, True)],
)
def test_the_causes_of_the_slopes_are_named(
    gamma: float, focal_relative: float, is_response: bool, is_geometry: bool, tmp_path: Path
) -> None:
    found = _measure(tmp_path, gamma, focal_relative)
    assert "stale" in found.flagged[0]
    assert ("the response of panel and camera is not linear" in found.reason) == is_response
    assert ("of its size" in found.reason) == is_geometry
    assert (found.geometry == "contradicted") == is_geometry


def _measure(folder: Path, gamma: float, focal_relative: float) -> MeasuredErrors:
    """A set with a stale frame, on a bench whose focal length is not as stated."""
    mirror = Mirror()
    bench = Bench.paper(EIGHTH).changed({"focal_relative": focal_relative})
    effects = replace(
        STILL, panel=Panel(gamma=gamma), stale_frame=STALE_FRAME, sensor=Sensor(read_adu=0.4)
    )
    truth = World(mirror, bench, effects, Stated(sigma_share=0.01), 3).write_set(folder, 0.0)
    return measured_errors(folder, mirror, truth, drawn_points_mm(np.random.default_rng(1), 3))
