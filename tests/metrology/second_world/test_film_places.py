"""Places of a resting film, as fringes of a panel with less contrast at an angle show them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from membrane_ctrl.measure.measurement import measure_set
from tests.worlds.second_optics import Bench, Effects, Mirror, Panel, Sensor, World

EXACT = Sensor(bits=16, read_adu=0.5, full_well=0.0)


def test_contrast_that_falls_off_is_no_motion_of_the_film(tmp_path: Path) -> None:
    """The film seemed to swing by 0.5 µm from frame to frame, and so perhaps from x to y."""
    panel = Panel(contrast_falloff=0.12)
    effects = Effects(panel=panel, sensor=EXACT, psf_px=0.0, laser_noise_um=0.0)
    World(Mirror(), Bench.paper(0.125), effects).write_set(tmp_path)
    checked = measure_set(tmp_path).checked
    assert checked is not None
    assert np.abs(checked.film_um).max() < 0.05
