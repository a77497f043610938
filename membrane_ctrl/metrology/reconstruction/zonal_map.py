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

from membrane_ctrl.metrology.numerics.compiled import kernel, split
from membrane_ctrl.model.arrays import FloatArray

# Height from differences between neighbours on a masked grid: least squares by conjugate gradients
# and multigrid.
#
# Minimise sum over neighbours (h_b - h_a - d_ab)^2 over pairs that are both inside the mask. The
# normal equations are the grid's Laplacian with the mask's own (Neumann) edge. Cells are joined 2 x
# 2 into a coarser grid whose links are sums of the finer ones (Galerkin with constants), down to a
# few cells; one symmetric V-cycle of that is the preconditioner. The cost is linear in the number
# of cells.
#
# Source: R. Southwell's model of slopes, J. Opt. Soc. Am. 70, 998 (1980); A. Brandt, Math. Comp.
# 31, 333 (1977).

_COARSEST = 8
# Constants joined 2 x 2 interpolate a slope as a staircase, which makes the coarse correction too
# small by about half
_OVER_CORRECTION = 1.8


@kernel
def _smooth(right, down, rhs, h, forward):  # type: ignore[no-untyped-def]
    """One Gauss-Seidel sweep; `right[i, j]` links (i, j) to (i, j + 1), `down[i, j]` to (i + 1,
    j).
    """
    rows, columns = h.shape
    for a in range(rows):
        i = a if forward else rows - 1 - a
        for b in range(columns):
            j = b if forward else columns - 1 - b
            total = 0.0
            weight = 0.0
            if j > 0:
                weight += right[i, j - 1]
                total += right[i, j - 1] * h[i, j - 1]
            if j + 1 < columns:
                weight += right[i, j]
                total += right[i, j] * h[i, j + 1]
            if i > 0:
                weight += down[i - 1, j]
                total += down[i - 1, j] * h[i - 1, j]
            if i + 1 < rows:
                weight += down[i, j]
                total += down[i, j] * h[i + 1, j]
            if weight > 0:
                h[i, j] = (rhs[i, j] + total) / weight


@kernel
def _apply(right, down, h, out):  # type: ignore[no-untyped-def]
    """The Laplacian of h."""
    rows, columns = h.shape
    out[:, :] = 0.0
    for i in range(rows):
        for j in range(columns):
            if j + 1 < columns:
                flow = right[i, j] * (h[i, j] - h[i, j + 1])
                out[i, j] += flow
                out[i, j + 1] -= flow
            if i + 1 < rows:
                flow = down[i, j] * (h[i, j] - h[i + 1, j])
                out[i, j] += flow
                out[i + 1, j] -= flow


@kernel
def _restrict(fine, coarse):  # type: ignore[no-untyped-def]
    coarse[:, :] = 0.0
    for i in range(fine.shape[0]):
        for j in range(fine.shape[1]):
            coarse[i // 2, j // 2] += fine[i, j]


@kernel
def _prolong(coarse, fine, scale):  # type: ignore[no-untyped-def]
    for i in range(fine.shape[0]):
        for j in range(fine.shape[1]):
            fine[i, j] += scale * coarse[i // 2, j // 2]


@kernel
def _coarser_links(right, down, coarse_right, coarse_down):  # type: ignore[no-untyped-def]
    """Links that cross from one joined cell to the next, summed."""
    rows, columns = right.shape
    coarse_right[:, :] = 0.0
    coarse_down[:, :] = 0.0
    for i in range(rows):
        for j in range(columns):
            if j % 2 == 1 and j + 1 < columns:
                coarse_right[i // 2, j // 2] += right[i, j]
            if i % 2 == 1 and i + 1 < rows:
                coarse_down[i // 2, j // 2] += down[i, j]


class MaskedLaplacian:
    """Links of a grid and of its coarser ones.

    `right` and `down` (rows, columns) are the weights of each cell's links to its right and to its
    lower neighbour, 0 where there is none.
    """

    def __init__(self, right: FloatArray, down: FloatArray) -> None:
        self._links = [(right, down)]
        while min(self._links[-1][0].shape) > _COARSEST:
            fine = self._links[-1]
            shape = tuple((n + 1) // 2 for n in fine[0].shape)
            coarse = np.empty(shape), np.empty(shape)
            _coarser_links(*fine, *coarse)
            self._links.append(coarse)
        self._memory = [np.empty((3, *links[0].shape)) for links in self._links]

    def solve(
        self, rhs: FloatArray, tolerance: float = 1e-4, max_iterations: int = 60
    ) -> FloatArray:
        """h with Laplacian(h) = rhs; each connected part up to its own constant.

        Stops when the residual has fallen by `tolerance`.
        """
        h, residual = np.zeros_like(rhs), rhs.copy()
        out = np.empty_like(rhs)
        direction = np.zeros_like(rhs)
        last, target = 1.0, tolerance * float(np.linalg.norm(rhs))
        for _ in range(max_iterations):
            if float(np.linalg.norm(residual)) <= target:
                break
            z = self._cycle(0, residual)
            product = float(np.vdot(residual, z))
            direction *= product / last
            direction += z
            last = product
            _apply(*self._links[0], direction, out)
            step = product / float(np.vdot(direction, out))
            h += step * direction
            residual -= step * out
        return h

    def _cycle(self, level: int, rhs: FloatArray) -> FloatArray:
        """One symmetric V-cycle from zero."""
        right, down = self._links[level]
        h, residual, _ = self._memory[level]
        h[:] = 0.0
        _smooth(right, down, rhs, h, True)
        if level + 1 == len(self._links):
            for _ in range(2 * _COARSEST):
                _smooth(right, down, rhs, h, False)
                _smooth(right, down, rhs, h, True)
        else:
            _apply(right, down, h, residual)
            np.subtract(rhs, residual, out=residual)
            coarse = self._memory[level + 1][2]
            _restrict(residual, coarse)
            _prolong(self._cycle(level + 1, coarse), h, _OVER_CORRECTION)
        _smooth(right, down, rhs, h, False)
        return np.asarray(h)


_CELLS_A_SIDE = 951  # over the analysis' diameter: 1 mm cells on a 1 m mirror, near two pixels each
FIT_CYCLES = 4.0  # over the aperture: slower waves belong to the fit
_PIXELS_A_CELL = 1.5  # with fewer, cells would be empty between pixels


@dataclass(frozen=True)
class ResidualGrid:
    """Mean slope residual on a square grid of cells with the vertex in the middle one."""

    axis_mm: FloatArray  # (n,): middle of the cells, along x and along y alike
    slope_x: FloatArray  # (n, n): rows along y; 0 where there is none
    slope_y: FloatArray  # (n, n)
    count: FloatArray  # (n, n): weight of the pixels in each cell

    @property
    def step_mm(self) -> float:
        """Side of a cell."""
        return float(self.axis_mm[1] - self.axis_mm[0])

    def noise_mm(self, cell_slope: float) -> float:
        """1 sigma of the integrated height when the cells' slopes have this white noise.

        The height's density over the plane of waves k is (slope step / k)^2, from the fastest that
        the grid holds to the slowest that the fit of the terms leaves.
        """
        fastest, slowest = (
            2 * math.sqrt(math.pi) / self.step_mm,
            math.pi * FIT_CYCLES / float(self.axis_mm[-1]),
        )
        return (
            cell_slope
            * self.step_mm
            * math.sqrt(max(math.log(fastest / slowest), 0.0) / (2 * math.pi))
        )


@kernel
def _scatter(field, weights, first_mm, step_mm, sums, start, stop):  # type: ignore[no-untyped-def]
    n = sums.shape[1]
    for p in range(start, stop):
        w = weights[p]
        if not w > 0:
            continue
        j = math.floor((field[0, p] - first_mm) / step_mm + 0.5)
        i = math.floor((field[1, p] - first_mm) / step_mm + 0.5)
        if i < 0 or j < 0 or i >= n or j >= n:
            continue
        sums[0, i, j] += w
        sums[1, i, j] += w * (field[2, p] - field[4, p])
        sums[2, i, j] += w * (field[3, p] - field[5, p])


def residual_grid(field: FloatArray, weights: FloatArray, radius_mm: float) -> ResidualGrid:
    """Average the residual in cells.

    Parameters
    ----------
    field : (6, n) array
        Rows of `Tracer.slope_field`.
    weights : (n,) array
        0 leaves a pixel out.
    """
    half = (
        min(_CELLS_A_SIDE, int(math.sqrt(4 / math.pi * max(field.shape[1], 1) / _PIXELS_A_CELL)))
        // 2
    )
    half = max(half, 2)
    axis: FloatArray = radius_mm / half * np.arange(-half, half + 1, dtype=np.float64)

    def run(start: int, stop: int) -> FloatArray:
        sums = np.zeros((3, axis.size, axis.size))
        _scatter(field, weights, axis[0], axis[1] - axis[0], sums, start, stop)
        return sums

    sums, *others = split(run, field.shape[1])
    for other in others:  # in place: here a measurement takes the most memory
        sums += other
    count, x, y = sums
    safe = np.where(count > 0, count, 1.0)
    return ResidualGrid(axis, x / safe, y / safe, count)


def integrate(grid: ResidualGrid) -> FloatArray:
    """Height (n, n) in mm of the residual, 0 at the vertex; NaN where nothing was measured.

    Slopes cannot tell the relative height of parts that are not connected (a hair across the
    mirror): each is put on the fitted surface, mean 0.
    """
    seen = grid.count > 0
    right = np.zeros(seen.shape)
    down = np.zeros(seen.shape)
    right[:, :-1] = seen[:, :-1] & seen[:, 1:]
    down[:-1] = seen[:-1] & seen[1:]
    rise_x = np.zeros(seen.shape)
    rise_y = np.zeros(seen.shape)
    rise_x[:, :-1] = right[:, :-1] * (grid.slope_x[:, :-1] + grid.slope_x[:, 1:]) * grid.step_mm / 2
    rise_y[:-1] = down[:-1] * (grid.slope_y[:-1] + grid.slope_y[1:]) * grid.step_mm / 2
    rhs = -rise_x - rise_y
    rhs[:, 1:] += rise_x[:, :-1]
    rhs[1:] += rise_y[:-1]
    height = MaskedLaplacian(right, down).solve(rhs)
    _, parts = cv2.connectedComponents(seen.astype(np.uint8), connectivity=4)
    means = np.bincount(parts.ravel(), height.ravel()) / np.maximum(np.bincount(parts.ravel()), 1)
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
