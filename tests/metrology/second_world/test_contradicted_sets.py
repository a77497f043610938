"""Sets whose slopes belong to no surface: their contrast shows no blur."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.studies.second_benches import draw_bench
from tests.studies.second_world_errors import measured_errors


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
