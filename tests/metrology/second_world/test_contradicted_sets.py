"""Sets whose slopes belong to no surface: what is named as the cause, and what is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from membrane_ctrl.measure.measurement import measure_set
from tests.studies.second_benches import FOLDING_LENS, draw_bench
from tests.studies.second_world_errors import measured_errors
from tests.worlds.second_optics import Bench, Mirror, Stated, World


def test_a_sharp_set_that_contradicts_its_bench_is_not_called_blurred(tmp_path: Path) -> None:
    """A stale frame, moving film and a bent response: "blurred by 0.8 px: focus the camera"."""
    drawn = draw_bench(1, 0.125)
    assert not any(cause.startswith("blur") for cause in drawn.planted)
    place_um = float(np.random.default_rng((4748, 1)).uniform(-50.0, 50.0))
    truth = drawn.world.write_set(tmp_path / "set", place_um)
    found = measured_errors(tmp_path / "set", drawn.world.mirror, truth, np.zeros((2, 1)))
    assert found.verdict == "rejected"
    assert "the response of panel and camera is not linear" in found.reason
    assert "blurred" not in found.reason


def test_a_lens_that_folds_and_contradicts_the_frames_makes_the_figure_unusable(
    tmp_path: Path,
) -> None:
    """It folds beside the mirror, where no ray goes, but it is wrong within the mirror, too."""
    stated = Stated(sigma_share=0.01, camera={"distortion": FOLDING_LENS})
    world = World(Mirror(), Bench.paper(0.125), stated=stated)
    truth = world.write_set(tmp_path / "set")
    found = measured_errors(tmp_path / "set", world.mirror, truth, np.full((2, 1), 100.0))
    assert found.worst_sigmas > 3
    assert found.verdict == "rejected"
    assert found.reason.startswith("camera.distortion: the lens model folds")


def test_turned_pictures_are_named_where_a_frame_was_blamed_for_them(tmp_path: Path) -> None:
    """Without that frame the harmonics of a gamma hid the orientation: the set was `degraded`."""
    draw_bench(500, 0.125).world.write_set(tmp_path, 0.0)
    measurement = measure_set(tmp_path)
    assert measurement.verdict == "rejected"
    assert "the pictures are rotated by 180 degrees" in measurement.reason
