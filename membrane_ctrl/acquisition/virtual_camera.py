"""The measurement cycle on the twin's camera in virtual time: real frames, real reconstruction, no
waiting.

The film stands still while the frames of a cycle are taken, because the virtual plant does not
advance meanwhile; motion between frames belongs to runs in real time and to `simulate`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from firmware_iface.optical_roles import Pixels
from membrane_ctrl.config.schema import Config
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.phase.pattern_sequence import fringe_sequence, full_sequence
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.sim.optics.camera import TwinOptics
from membrane_ctrl.sim.plant import Plant


class VirtualCamera:
    """A source of shapes (`virtual_run.ShapeSource`): each call takes one cycle.

    Parameters
    ----------
    config : Config
        The run's configuration.
    plant : Plant
        The twin's physics.
    alter : callable, optional
        What a lens out of focus, or another fault, makes of a picture.
    """

    def __init__(
        self, config: Config, plant: Plant, alter: Callable[[Pixels], Pixels] | None = None
    ) -> None:
        self._alter = alter
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
        frames = []
        readings_um = []
        for shown in sequence:
            self._optics.screen.show(shown)
            pixels = self._optics.camera.grab().pixels
            frames.append(pixels.copy() if self._alter is None else self._alter(pixels))
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
