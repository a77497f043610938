"""A measured surface on a square grid: heights and slopes."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True)
class SurfaceMap:
    """A surface on a square grid.

    Attributes
    ----------
    axis_mm : (n,) array
        Middle of the cells, along x as along y.
    height_mm : (n, n) array
        Rows along y; NaN where not measured.
    slope_x, slope_y : (n, n) arrays
        Slopes; used where there is a height.
    """

    axis_mm: FloatArray
    height_mm: FloatArray
    slope_x: FloatArray
    slope_y: FloatArray

    def take_every(self, stride: int) -> "SurfaceMap":
        """Every `stride`-th cell along both axes."""
        every = slice(None, None, stride)
        return SurfaceMap(
            axis_mm=self.axis_mm[every],
            height_mm=self.height_mm[every, every],
            slope_x=self.slope_x[every, every],
            slope_y=self.slope_y[every, every],
        )

    def add_change(self, change: FloatArray) -> "SurfaceMap":
        """With another height and slopes (3, n, n) added."""
        return SurfaceMap(
            axis_mm=self.axis_mm,
            height_mm=self.height_mm + change[0],
            slope_x=self.slope_x + change[1],
            slope_y=self.slope_y + change[2],
        )

    def points(self) -> FloatArray:
        """Rows (3, cells) x, y, z of the measured cells in mm."""
        seen = np.isfinite(self.height_mm)
        rows, columns = np.nonzero(seen)
        return np.stack([self.axis_mm[columns], self.axis_mm[rows], self.height_mm[seen]])
