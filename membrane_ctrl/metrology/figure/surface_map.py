"""A measured surface on a square grid: heights and slopes."""

from dataclasses import astuple, dataclass

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

    def part(self, stride: int) -> "SurfaceMap":
        """Every `stride`-th cell along both axes."""
        every = slice(None, None, stride)
        return SurfaceMap(self.axis_mm[every], *(a[every, every] for a in astuple(self)[1:]))

    def plus(self, change: FloatArray) -> "SurfaceMap":
        """With another height and slopes (3, n, n) added."""
        now = self.height_mm + change[0], self.slope_x + change[1], self.slope_y + change[2]
        return SurfaceMap(self.axis_mm, *now)

    def points(self) -> FloatArray:
        """Rows (3, cells) x, y, z of the measured cells in mm."""
        seen = np.isfinite(self.height_mm)
        rows, columns = np.nonzero(seen)
        return np.stack([self.axis_mm[columns], self.axis_mm[rows], self.height_mm[seen]])
