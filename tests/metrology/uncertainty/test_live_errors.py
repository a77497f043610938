"""What the bars of a live cycle hold beyond the noise of its pixels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.metrology.figure import set_motion
from membrane_ctrl.metrology.uncertainty.cycle_errors import LiveErrors
from membrane_ctrl.metrology.uncertainty.cycle_frames import FrameErrors
from membrane_ctrl.metrology.uncertainty.frame_effects import FrameEffects

TERMS, FRAMES = 2, 8


def vertex_sigma_um(moved_um: float, reading_um: float) -> float:
    """Of a bench on which only the vertex' place has an effect: 1 mm of the second parameter per
    µm.
    """
    none, still = np.zeros((TERMS, FRAMES)), np.zeros((TERMS, TERMS))
    errors = LiveErrors(
        FrameEffects(none, none, none, none), np.array([0.0, 1.0]), still, still, still
    )
    quiet = np.zeros(FRAMES)
    film = moved_um * np.tile([1.0, -1.0], FRAMES // 2)
    seen = FrameErrors(quiet, quiet, quiet, film, np.zeros((2, 2)), np.zeros((2, 1)))
    return math.sqrt(
        errors.unshared_covariance_mm2(seen, np.full(FRAMES, reading_um), 1.0, 0.0)[1, 1]
    )


def test_a_film_that_moves_without_a_laser_leaves_the_vertex_unknown_by_half_its_motion() -> None:
    resting_um, moving_um = vertex_sigma_um(0.0, math.nan), vertex_sigma_um(100.0, math.nan)
    beyond_um = math.sqrt(moving_um**2 - resting_um**2)
    assert beyond_um == pytest.approx(set_motion.X_TO_Y * 100.0 / 2)


def test_a_laser_reading_gives_the_place_of_the_vertex() -> None:
    assert vertex_sigma_um(100.0, 3.0) == pytest.approx(1 / math.sqrt(FRAMES))
