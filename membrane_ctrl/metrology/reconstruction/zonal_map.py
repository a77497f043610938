"""The zonal map: what the terms cannot represent, integrated from the slopes' residual to the fit.

Only the residual is integrated, so that neither the grid's step nor its interpolation touches the
millimetres of the bowl. Slopes scattered over the mirror are averaged in cells; two neighbouring
cells see the height change by the mean of their slopes (Southwell's model); least squares over all
pairs of neighbours give the height.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from membrane_ctrl.metrology.numerics.compiled import compile_kernel
from membrane_ctrl.metrology.reconstruction.masked_laplacian import MaskedLaplacian
from membrane_ctrl.model.arrays import FloatArray

_CELLS_A_SIDE = 951  # over the analysis' diameter: 1 mm cells on a 1 m mirror, near two pixels each
FIT_CYCLES = 4.0  # over the aperture: slower waves belong to the fit
_PIXELS_A_CELL = 1.5  # with fewer, cells would be empty between pixels


@dataclass(frozen=True)
class ResidualGrid:
    """Mean slope residual on a square grid of cells with the vertex in the middle one.

    Attributes
    ----------
    axis_mm : (n,) array
        Middle of the cells, along x as along y.
    slope_x, slope_y : (n, n) arrays
        Mean residual; rows along y; 0 where nothing was measured.
    count : (n, n) array
        Weight of the pixels in each cell.
    """

    axis_mm: FloatArray
    slope_x: FloatArray
    slope_y: FloatArray
    count: FloatArray

    @property
    def step_mm(self) -> float:
        """Side of a cell."""
        return float(self.axis_mm[1] - self.axis_mm[0])

    def noise_mm(self, cell_slope: float) -> float:
        """1 sigma of the integrated height when the cells' slopes have this white noise.

        The height's density over the plane of waves k is (slope step / k)^2, from the fastest that
        the grid holds to the slowest that the fit of the terms leaves.
        """
        fastest = 2 * math.sqrt(math.pi) / self.step_mm
        slowest = math.pi * FIT_CYCLES / float(self.axis_mm[-1])
        integral = max(math.log(fastest / slowest), 0.0) / (2 * math.pi)
        return cell_slope * self.step_mm * math.sqrt(integral)


@compile_kernel
def _scatter_samples(field, weights, first_mm, step_mm, sums, start, stop):  # type: ignore[no-untyped-def]
    """Add weight and weighted residuals of pixels to the cells, `sums` (3, n, n).

    Rows of `field` (6, pixels): x, y, measured slopes, fitted slopes.
    """
    n = sums.shape[1]
    for p in range(start, stop):
        w = weights[p]
        if not w > 0:
            continue
        # The cell whose middle is nearest, if the grid has it.
        j = math.floor((field[0, p] - first_mm) / step_mm + 0.5)
        i = math.floor((field[1, p] - first_mm) / step_mm + 0.5)
        if i < 0 or j < 0 or i >= n or j >= n:
            continue
        # Weight, and weight times (measured - fitted) along x and along y.
        sums[0, i, j] += w
        sums[1, i, j] += w * (field[2, p] - field[4, p])
        sums[2, i, j] += w * (field[3, p] - field[5, p])


class CellSums:
    """Sums of the residual over cells, to which pixels are added in parts.

    Parameters
    ----------
    pixels : int
        Number of pixels in all: they fill a disc, pi / 4 of the square's cells. The cells are as
        fine as it allows, at most `_CELLS_A_SIDE` a side.
    radius_mm : float
        Radius of the analysis: half the grid's side.
    """

    def __init__(self, pixels: int, radius_mm: float) -> None:
        filled_side = int(math.sqrt(4 / math.pi * max(pixels, 1) / _PIXELS_A_CELL))
        half = max(min(_CELLS_A_SIDE, filled_side) // 2, 2)
        self._axis_mm: FloatArray = radius_mm / half * np.arange(-half, half + 1, dtype=np.float64)
        self._sums = np.zeros((3, self._axis_mm.size, self._axis_mm.size))

    def add_pixels(self, field: FloatArray, weights: FloatArray) -> None:
        """Add pixels to the sums of their cells.

        Parameters
        ----------
        field : (6, n) array
            Rows of `Tracer.slope_field`: x and y in mm, measured slopes, fitted slopes. Pixels
            beyond the grid are ignored.
        weights : (n,) array
            0 leaves a pixel out.
        """
        step_mm = self._axis_mm[1] - self._axis_mm[0]
        count = field.shape[1]
        _scatter_samples(field, weights, self._axis_mm[0], step_mm, self._sums, 0, count)

    def mean_residual(self) -> ResidualGrid:
        """Means over the cells."""
        count, x, y = self._sums
        safe = np.where(count > 0, count, 1.0)
        return ResidualGrid(self._axis_mm, x / safe, y / safe, count)


def residual_grid(field: FloatArray, weights: FloatArray, radius_mm: float) -> ResidualGrid:
    """Average the residual in cells.

    Parameters
    ----------
    field : (6, n) array
        Rows of `Tracer.slope_field`.
    weights : (n,) array
        0 leaves a pixel out.
    radius_mm : float
        Radius of the analysis: half the grid's side.

    Returns
    -------
    ResidualGrid
    """
    cells = CellSums(field.shape[1], radius_mm)
    cells.add_pixels(field, weights)
    return cells.mean_residual()


def integrate_residual(grid: ResidualGrid) -> FloatArray:
    """Integrate the residual slopes to heights, by least squares over the grid's links.

    Slopes do not determine the relative height of parts that are not connected (a hair across the
    mirror): each is put on the fitted surface, mean 0.

    Parameters
    ----------
    grid : ResidualGrid
        Residual slopes of n x n cells.

    Returns
    -------
    (n, n) array
        Height in mm, 0 at the vertex; NaN where nothing was measured.
    """
    # Links of each cell to its right and to its lower neighbour: 1 if both were measured.
    seen = grid.count > 0
    right = np.zeros(seen.shape)
    down = np.zeros(seen.shape)
    right[:, :-1] = seen[:, :-1] & seen[:, 1:]
    down[:-1] = seen[:-1] & seen[1:]

    # Rise along each link, by the mean slope of its two cells (W. H. Southwell, J. Opt. Soc. Am.
    # 70, 998 (1980)).
    slope_sum_x = grid.slope_x[:, :-1] + grid.slope_x[:, 1:]
    slope_sum_y = grid.slope_y[:-1] + grid.slope_y[1:]
    rise_x = np.zeros(seen.shape)
    rise_y = np.zeros(seen.shape)
    rise_x[:, :-1] = right[:, :-1] * slope_sum_x * grid.step_mm / 2
    rise_y[:-1] = down[:-1] * slope_sum_y * grid.step_mm / 2

    # Least squares over the links, sum of (h_b - h_a - rise)^2. Its normal equations have the
    # grid's Laplacian on the left, and on the right of each cell the rises into it less those out
    # of it.
    rhs = -rise_x - rise_y
    rhs[:, 1:] += rise_x[:, :-1]
    rhs[1:] += rise_y[:-1]
    height = MaskedLaplacian(right, down).solve(rhs)

    # Each connected part has mean 0; then the vertex is at 0.
    _, parts = cv2.connectedComponents(seen.astype(np.uint8), connectivity=4)
    sizes = np.bincount(parts.ravel())
    sums = np.bincount(parts.ravel(), height.ravel())
    means = sums / np.maximum(sizes, 1)
    height = np.where(seen, height - means[parts], np.nan)
    return height - _at_vertex(height)


def _at_vertex(height: FloatArray) -> float:
    """The middle cell, or the nearest that was seen."""
    if not np.isfinite(height).any():
        return 0.0
    middle = height.shape[0] // 2
    rows, columns = np.nonzero(np.isfinite(height))
    nearest = np.argmin((rows - middle) ** 2 + (columns - middle) ** 2)
    return float(height[rows[nearest], columns[nearest]])
