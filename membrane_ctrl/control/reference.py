"""The reference of the shape loop: the mean of the first shapes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.estimate import ShapeEstimate

# What the reference is off stays as an offset of the figure for good: the mean has less than half the scatter of one,
# at the price of a few cycles without the trim.
SHAPES = 5


class ReferenceMean:
    """Mean coefficients, laser reading and time of a few shapes."""

    def __init__(self) -> None:
        self._taken: list[ShapeEstimate] = []
        self.coeffs_um: NDArray[np.float64] = np.empty(0)
        self.displacement_um = self.time_s = math.nan

    @property
    def wanted(self) -> int:
        """Number of shapes that make a reference."""
        return SHAPES

    @property
    def count(self) -> int:
        """Number taken."""
        return len(self._taken)

    @property
    def complete(self) -> bool:
        """Whether there are enough."""
        return self.count == SHAPES

    def take(self, estimate: ShapeEstimate) -> None:
        """Take one more."""
        self._taken.append(estimate)
        self.coeffs_um = np.mean([e.coeffs_um for e in self._taken], axis=0)
        self.displacement_um = float(np.mean([e.displacement_um for e in self._taken]))
        self.time_s = float(np.mean([e.time_s for e in self._taken]))
