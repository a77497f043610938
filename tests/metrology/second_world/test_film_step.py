"""A film that steps between the x and the y frames while a laser reads it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.studies.second_world_errors import drawn_points_mm, measured_errors
from tests.worlds.second_optics import FRAME_S, Bench, Effects, Mirror, Sensor, Stated, World

STILL = Effects(sensor=Sensor(bits=12, read_adu=2.0), psf_px=0.0)
FIRST_Y_FRAME_S = 7.5 * FRAME_S


@pytest.mark.parametrize("step_um", [0.0, 5.0, 50.0])
def test_a_step_that_the_laser_reads_is_corrected(step_um: float, tmp_path: Path) -> None:
    """Within each axis the film rests; the step alone bent the figure by 7.7 µm at 50 µm."""
    mirror = Mirror()
    effects = replace(STILL, film_motion_um=lambda time_s: step_um * (time_s > FIRST_Y_FRAME_S))
    world = World(mirror, Bench.paper(0.125), effects, Stated(sigma_share=0.01))
    truth = world.write_set(tmp_path / "set")
    points_mm = drawn_points_mm(np.random.default_rng(1), 40)
    found = measured_errors(tmp_path / "set", mirror, truth, points_mm)
    assert found.error_um is not None
    assert np.sqrt(np.mean(found.error_um[9:] ** 2)) < 0.3  # µm
    assert found.worst_sigmas < 3
    assert found.verdict == "ok"
