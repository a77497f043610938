"""Points of a square map inside the analysed disc of the mirror."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class ApertureGrid:
    """A square map over the analysed disc.

    Attributes
    ----------
    axis_mm : (m,) array
        Places of rows and columns.
    x_mm, y_mm : (m, m) array
        Places of all points.
    inside : (m, m) bool array
        Points of the disc, n of them.
    """

    axis_mm: FloatArray
    x_mm: FloatArray
    y_mm: FloatArray
    inside: BoolArray

    @classmethod
    def over_disc(cls, reach_mm: float, side: int) -> "ApertureGrid":
        """Make the grid over a disc.

        Parameters
        ----------
        reach_mm : float
            Radius of the disc, half the side of the map.
        side : int
            m, points along a side.
        """
        axis_mm = np.linspace(-reach_mm, reach_mm, side)
        x_mm, y_mm = np.meshgrid(axis_mm, axis_mm)
        return cls(axis_mm, x_mm, y_mm, np.hypot(x_mm, y_mm) <= reach_mm)

    @property
    def places_mm(self) -> FloatArray:
        """x and y of the points of the disc, (2, n)."""
        return np.stack([self.x_mm[self.inside], self.y_mm[self.inside]])

    def fill_map(self, values: FloatArray) -> FloatArray:
        """A map (m, m) of values (n,) at the points of the disc; NaN outside."""
        picture = np.full(self.inside.shape, np.nan)
        picture[self.inside] = values
        return picture

    def clip_map(self, values: FloatArray) -> FloatArray:
        """A map (m, m) without the values outside the disc, which become NaN."""
        return np.where(self.inside, values, np.nan)
