"""The reference of the shape loop: the mean of the first shapes. Pure."""

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from membrane_ctrl.model import shape_estimate
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.state_tree import ArrayShape, StateNode
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

# An error of the reference remains as an offset of the figure: the mean has less than half the
# scatter of one shape, at the price of a few cycles without the trim.
SHAPES = 5
# Figures of single frames come faster than the laser's noise averages out: as many readings as five
# cycles have.
TRACKED_SHAPES = 25
TRACKED_EVERY_S = 0.4
_Coefficients = Annotated[FloatArray, ArrayShape((ZERNIKE_TERMS,))]


@dataclass(frozen=True, slots=True)
class ReferenceShape(StateNode):
    """One of the shapes that make a reference."""

    time_s: float
    displacement_um: float
    coeffs_um: _Coefficients
    of_frame: bool  # tracked in a single frame


@dataclass(slots=True)
class ReferenceMean(StateNode):
    """Mean coefficients, laser reading and time of a few shapes."""

    taken: list[ReferenceShape] = field(default_factory=list)
    coeffs_um: _Coefficients = field(default_factory=lambda: np.full(ZERNIKE_TERMS, math.nan))
    displacement_um: float = math.nan
    time_s: float = math.nan

    @property
    def wanted(self) -> int:
        """Number of shapes that make a reference."""
        if self.taken and self.taken[-1].of_frame:
            return TRACKED_SHAPES
        return SHAPES

    @property
    def count(self) -> int:
        """Number taken."""
        return len(self.taken)

    @property
    def complete(self) -> bool:
        """Whether there are enough."""
        return self.count >= self.wanted

    def add_estimate(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Take one more; of single frames, one per `TRACKED_EVERY_S`."""
        of_frame = estimate.kind == "track"
        if self.taken and of_frame and estimate.time_s < self.taken[-1].time_s + TRACKED_EVERY_S:
            return
        coeffs_um = np.array(estimate.coeffs_um, dtype=float)
        self.taken.append(
            ReferenceShape(estimate.time_s, estimate.displacement_um, coeffs_um, of_frame)
        )
        self.coeffs_um = np.mean([shape.coeffs_um for shape in self.taken], axis=0)
        self.displacement_um = float(np.mean([shape.displacement_um for shape in self.taken]))
        self.time_s = float(np.mean([shape.time_s for shape in self.taken]))
