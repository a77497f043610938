"""Jumps of the figure at steps of the pattern: image retention of the panel."""

from collections import deque

import numpy as np

from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.metrology.tracking.frame_fit import Shifts
from membrane_ctrl.metrology.tracking.step_solution import ENOUGH_STEPS
from membrane_ctrl.model.arrays import FloatArray

_STILL_FRAMES = 50
_STEP_FRAMES = 5 * ENOUGH_STEPS  # fewer scatter too much to give a variance


class StepJumps:
    """How much more the figure changes at a step of the pattern than from frame to frame.

    A panel with image retention shows the former step together with the present one, which looks
    like a tilt. The measure is the second difference of the parameters over three frames,
    (p_3 - 2 p_2 + p_1)^2, with and without a step before the last frame.
    """

    def __init__(self) -> None:
        self._still_mm2: deque[FloatArray] = deque(maxlen=_STILL_FRAMES)
        self._steps_mm2: deque[FloatArray] = deque(maxlen=_STEP_FRAMES)
        self.forget_frames()

    def forget_frames(self) -> None:
        """Do not compare the next frame with those before it."""
        self._path: deque[tuple[Shifts, FloatArray]] = deque(maxlen=3)

    def add_frame(self, shifts_rad: Shifts, parameters: FloatArray) -> bool:
        """Add the next frame.

        Parameters
        ----------
        shifts_rad : (float, float)
            Its phase steps of x and y.
        parameters : (parameters,) array
            Those of its surface, mm.

        Returns
        -------
        bool
            Whether the pattern stepped before this frame, so that it shows the size of a jump.
        """
        self._path.append((shifts_rad, parameters))
        # The first two of the three frames must show the same step.
        if len(self._path) < 3 or self._path[0][0] != self._path[1][0]:
            return False
        before, last, present = (place for _, place in self._path)
        squared_mm2 = (present - 2 * last + before) ** 2
        stepped = shifts_rad != self._path[1][0]
        if stepped:
            self._steps_mm2.append(squared_mm2)
        else:
            self._still_mm2.append(squared_mm2)
        return stepped

    def variance_mm2(self, place_mm2: FloatArray) -> FloatArray:
        """Variance (parameters,) of a jump beyond that of the steps' places, `place_mm2`
        (parameters,), which jump, too.

        Zeros where frames of one step scatter nearly as much.
        """
        if not self._steps_mm2 or not self._still_mm2:
            return np.zeros(surface.PARAMETERS)
        steps_mm2 = np.mean(self._steps_mm2, axis=0)
        still_mm2 = np.mean(self._still_mm2, axis=0)
        return np.asarray(np.maximum(steps_mm2 - 2 * still_mm2 - 2 * place_mm2, 0.0))
