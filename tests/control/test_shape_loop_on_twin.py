"""Both loops on the twin with a drifting laser, in virtual time; shapes are made from the truth and
noise.
"""

from __future__ import annotations

import numpy as np

from membrane_ctrl.config.schema import TwinConfig
from membrane_ctrl.model.telemetry import ShapeState
from tests.studies.shape_loop import ON_S, SHAPE, track

DRIFTING = TwinConfig(laser_drift_um_per_min=2.0, start_error_um=0.0)


def moved_um(time_s: np.ndarray, true_um: np.ndarray) -> float:
    """Range of the true centre's 10 s means."""
    return float(np.ptp(true_um[time_s >= ON_S].reshape(-1, 500).mean(axis=1)))


def test_drifting_laser_does_not_move_the_figure() -> None:
    run = track(DRIFTING, 600.0, sag_noise_um=0.2)
    assert run.last.state == ShapeState.TRACKING
    assert moved_um(run.time_s, run.true_um) < 1.0


def test_without_the_shape_loop_the_figure_moves_by_the_drift() -> None:
    run = track(DRIFTING, 300.0, shape=SHAPE.model_copy(update={"enabled": False}))
    assert 9.0 < moved_um(run.time_s, run.true_um) < 11.0


def test_the_trim_adds_little_noise() -> None:
    run = track(TwinConfig(start_error_um=0.0), 600.0, sag_noise_um=0.2)
    assert run.trim_um[run.time_s > 240.0].std() < 0.06
    assert run.true_um[run.time_s > 240.0].std() < 0.15
