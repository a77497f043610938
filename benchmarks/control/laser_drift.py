"""A laser mount that drifts 2 µm/min for ten minutes, with and without the shape loop on full-size
frames.

Virtual time: the same controller, the same camera frames, the same reconstruction, without waiting.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from membrane_ctrl.acquisition.virtual_camera import VirtualCamera
from membrane_ctrl.config.schema import Config, ShapeConfig, TwinConfig
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.plant import Plant
from tests.support.figures import Figure, at_most
from tests.worlds.virtual_record import run_virtual

DRIFT_UM_PER_MIN = 2.0
MINUTES = 10


def true_sag_moved_um(with_shape: bool) -> float:
    """Largest movement of the true centre from its place at the start of the drift,
    as 10 s means.
    """
    twin = TwinConfig(laser_drift_um_per_min=DRIFT_UM_PER_MIN)
    config = Config(twin=twin, shape=ShapeConfig(enabled=with_shape))
    plant = Plant(twin, config.pump)
    camera: Callable[..., VirtualCamera] = VirtualCamera
    shape = camera(config, plant) if with_shape else None
    held = [
        tick.row.truth_displacement_um
        for tick in run_virtual(config, plant, 60.0 * MINUTES + 30.0, zernike_projection(), shape)
        if tick.row.state == State.HOLD
    ]
    window = round(10 * config.loop.rate_hz)
    means = np.array(held[: len(held) // window * window]).reshape(-1, window).mean(axis=1)
    return float(np.max(np.abs(means - means[0])))


def run() -> list[Figure]:
    """Both cases; the reference is the drift itself."""
    drift_um = DRIFT_UM_PER_MIN * MINUTES
    return [
        at_most(
            "true sag moved, shape loop on",
            true_sag_moved_um(True),
            "um",
            1.0,
            "laser drift",
            drift_um,
        ),
        at_most(
            "true sag moved, shape loop off",
            true_sag_moved_um(False),
            "um",
            None,
            "laser drift",
            drift_um,
        ),
    ]
