"""The measurement cycle on the twin's camera in virtual time: real frames, real reconstruction, no
waiting.

The film stands still while the frames of a cycle are taken (the virtual plant does not advance
meanwhile); motion between frames is the business of runs in real time and of `simulate`.
"""

from __future__ import annotations

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.phase.pattern_sequence import fringe_sequence, full_sequence
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.sim.optics.camera import TwinOptics
from membrane_ctrl.sim.plant import Plant


class VirtualCamera:
    """A `virtual_run.ShapeSource`: call it with the time, it takes a cycle of the plant as it is
    then.

    Parameters
    ----------
    config : Config
        The run's configuration.
    plant : Plant
        The twin's physics.
    """

    def __init__(self, config: Config, plant: Plant) -> None:
        self._config = config
        self._plant = plant
        self._now_s = 0.0
        self._optics = TwinOptics(config.optics, config.twin, plant.truth, self)
        self._reconstructor = LiveReconstructor(config.optics, config.shape.bin_px)
        self._full = True
        self._cycle = 0

    def now(self) -> float:
        """The time at which frames are taken."""
        return self._now_s

    def __call__(self, now_s: float) -> ShapeEstimate:
        """One cycle: full at first and after lost tracking, else fringes only."""
        self._now_s = now_s
        self._cycle += 1
        pattern = self._config.optics.pattern
        sequence = full_sequence(pattern) if self._full else fringe_sequence(pattern)
        frames, readings_um = [], []
        for shown in sequence:
            self._optics.screen.show(shown)
            frames.append(self._optics.camera.grab().pixels.copy())
            readings_um.append(self._plant.sample().displacement_um)
        take = (
            self._reconstructor.measure_full if self._full else self._reconstructor.measure_fringes
        )
        readings = np.full(
            len(frames), np.mean(readings_um)
        )  # the film stands still: so does its mean reading
        estimate = take(frames, np.full(len(frames), now_s), readings)
        self._full = estimate.verdict == "rejected"
        return estimate
