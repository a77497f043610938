"""Measured figures minute by minute, so that the figures of years are read in seconds.

Cycles and tracked frames of a minute become one row: how many there were, and the mean and
standard deviation of each Zernike coefficient over them. Rejected figures do not count.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.state_tree import ArrayShape, Count, StateNode
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

WINDOW_S = 60.0
_Coefficients = Annotated[FloatArray, ArrayShape((ZERNIKE_TERMS,))]


@dataclass(frozen=True)
class FigureMinute:
    """The figures of a minute.

    Attributes
    ----------
    time_s : float
        Start of the minute, s of the run.
    figures : int
        Number of figures.
    coeffs_um : (n,) array
        Mean of each coefficient, Noll 1 to n.
    scatter_um : (n,) array
        Standard deviation of single figures about that mean (divisor: their number).
    """

    time_s: float
    figures: int
    coeffs_um: FloatArray
    scatter_um: FloatArray


@dataclass(slots=True)
class OpenFigureMinute(StateNode):
    """The unfinished minute, which a successor of a dead recorder needs to finish.

    Attributes
    ----------
    start_s : float
        Start of the minute, s of the run; NaN before the first figure.
    figures : int
        Figures so far.
    mean_um : (n,) array
        Mean of each coefficient over them.
    squares_um2 : (n,) array
        Sum of the squared deviations from that mean.
    """

    start_s: float = math.nan
    figures: Count = 0
    mean_um: _Coefficients = field(default_factory=lambda: np.zeros(ZERNIKE_TERMS))
    squares_um2: _Coefficients = field(default_factory=lambda: np.zeros(ZERNIKE_TERMS))

    def add_figure(self, estimate: ShapeEstimate) -> FigureMinute | None:
        """Add a figure.

        Parameters
        ----------
        estimate : ShapeEstimate
            In order of time; a late one of an earlier minute counts in the present minute.

        Returns
        -------
        FigureMinute or None
            The minute that ended before this figure, if one did.
        """
        coeffs_um = np.asarray(estimate.coeffs_um, dtype=np.float64)
        is_usable = estimate.verdict != "rejected" and bool(np.isfinite(coeffs_um).all())
        if not is_usable:
            return None
        start_s = math.floor(estimate.time_s / WINDOW_S) * WINDOW_S
        ended = None
        if self.figures and start_s > self.start_s:
            ended = self.end_minute()
        if not self.figures:
            self.start_s = start_s
        # Welford's update: exact also for a scatter of nanometres about a sag of millimetres.
        self.figures += 1
        deviation_um = coeffs_um - self.mean_um
        self.mean_um = self.mean_um + deviation_um / self.figures
        self.squares_um2 = self.squares_um2 + deviation_um * (coeffs_um - self.mean_um)
        return ended

    def end_minute(self) -> FigureMinute | None:
        """End the minute, as at the end of a run.

        Returns
        -------
        FigureMinute or None
            None if it has no figure.
        """
        if not self.figures:
            return None
        scatter_um = np.sqrt(self.squares_um2 / self.figures)
        ended = FigureMinute(self.start_s, self.figures, self.mean_um, scatter_um)
        self.start_afresh()
        return ended
