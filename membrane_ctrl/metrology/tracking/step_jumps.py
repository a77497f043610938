"""Jumps of the figure at steps of the pattern: image retention of the panel."""

from collections import deque

import numpy as np

from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.metrology.tracking.step_solution import ENOUGH_STEPS
from membrane_ctrl.model.arrays import FloatArray


class Jumps:
    """By how much the figure jumps at steps of the pattern, beyond what it does from frame to
    frame.

    A panel on which pictures stick shows the former step beside the present one, which looks like a
    tilt.
    """

    def __init__(self) -> None:
        self._still: deque[FloatArray] = deque(maxlen=50)
        self._steps: deque[FloatArray] = deque(
            maxlen=5 * ENOUGH_STEPS
        )  # fewer scatter more than they tell
        self.begin()

    def begin(self) -> None:
        """What comes next is not compared with what was before."""
        self._path: deque[tuple[tuple[float, float], FloatArray]] = deque(maxlen=3)

    def add(self, shifts_rad: tuple[float, float], parameters: FloatArray) -> bool:
        """Take the next frame; True if it showed a jump's size."""
        self._path.append((shifts_rad, parameters))
        if len(self._path) < 3 or self._path[0][0] != self._path[1][0]:
            return False
        before, last, now = (place for _, place in self._path)
        stepped = shifts_rad != self._path[1][0]
        (self._steps if stepped else self._still).append((now - 2 * last + before) ** 2)
        return stepped

    def variance_mm2(self, place_mm2: FloatArray) -> FloatArray:
        """Of the parameters (parameters,), beyond that of the steps' places, which jump, too.

        Zeros where frames of one step scatter nearly as much.
        """
        if not self._steps or not self._still:
            return np.zeros(surface.PARAMETERS)
        steps_mm2, still_mm2 = (np.mean(squared, axis=0) for squared in (self._steps, self._still))
        return np.asarray(np.maximum(steps_mm2 - 2 * still_mm2 - 2 * place_mm2, 0.0))
