"""Height from differences between neighbours on a masked grid, by conjugate gradients and
multigrid.

Minimise sum over neighbours (h_b - h_a - d_ab)^2 over pairs that are both inside the mask. The
normal equations are the grid's Laplacian with the mask's own (Neumann) edge. Cells are joined 2 x
2 into a coarser grid whose links are sums of the finer ones (Galerkin with constants), down to a
few cells; one symmetric V-cycle of that is the preconditioner. The cost is linear in the number of
cells.

Source: R. Southwell's model of slopes, J. Opt. Soc. Am. 70, 998 (1980); A. Brandt, Math. Comp. 31,
333 (1977).
"""

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import compile_kernel
from membrane_ctrl.model.arrays import FloatArray

_COARSEST = 8  # cells a side of the coarsest grid
_COARSEST_SWEEPS = 2 * _COARSEST  # that solve it nearly exactly
# Constants joined 2 x 2 interpolate a slope as a staircase, which makes the coarse correction too
# small by about half.
_OVER_CORRECTION = 1.8


@compile_kernel
def _smooth_sweep(right, down, rhs, h, forward):  # type: ignore[no-untyped-def]
    """One Gauss-Seidel sweep, in either order of the cells.

    `right[i, j]` is the weight of the link from (i, j) to (i, j + 1), `down[i, j]` to (i + 1, j).
    Each cell gets the value that solves its own equation, sum of weight (h - h_neighbour) = rhs.
    """
    rows, columns = h.shape
    for a in range(rows):
        i = a
        if not forward:
            i = rows - 1 - a
        for b in range(columns):
            j = b
            if not forward:
                j = columns - 1 - b

            # Sum of weight, and of weight times height, over the neighbours on all four sides.
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

            # h = (rhs + sum of weight h_neighbour) / sum of weight.
            if weight > 0:
                h[i, j] = (rhs[i, j] + total) / weight


@compile_kernel
def _apply_laplacian(right, down, h, out):  # type: ignore[no-untyped-def]
    """The Laplacian of h into `out`: sum over the links of a cell of weight (h - h_neighbour)."""
    # Each link once: what it adds to one cell it takes from the other.
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


@compile_kernel
def _restrict_to_coarse(fine, coarse):  # type: ignore[no-untyped-def]
    """Sums over the joined cells."""
    coarse[:, :] = 0.0
    for i in range(fine.shape[0]):
        for j in range(fine.shape[1]):
            coarse[i // 2, j // 2] += fine[i, j]


@compile_kernel
def _prolong_to_fine(coarse, fine, scale):  # type: ignore[no-untyped-def]
    """Add the value of each joined cell, times `scale`, to its cells."""
    for i in range(fine.shape[0]):
        for j in range(fine.shape[1]):
            fine[i, j] += scale * coarse[i // 2, j // 2]


@compile_kernel
def _coarser_links(right, down, coarse_right, coarse_down):  # type: ignore[no-untyped-def]
    """Links that cross from one joined cell to the next, summed."""
    rows, columns = right.shape
    coarse_right[:, :] = 0.0
    coarse_down[:, :] = 0.0
    for i in range(rows):
        for j in range(columns):
            # A link from an odd column or row to the next one leaves its joined cell.
            if j % 2 == 1 and j + 1 < columns:
                coarse_right[i // 2, j // 2] += right[i, j]
            if i % 2 == 1 and i + 1 < rows:
                coarse_down[i // 2, j // 2] += down[i, j]


class MaskedLaplacian:
    """Links of a grid and of its coarser ones.

    Parameters
    ----------
    right, down : (rows, columns) array
        Weights of each cell's links to its right and to its lower neighbour, 0 where there is none.
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
        """Solve Laplacian(h) = rhs by preconditioned conjugate gradients.

        Parameters
        ----------
        rhs : (rows, columns) array
            0 outside the mask.
        tolerance : float
            Stop when the residual has fallen by this factor.
        max_iterations : int
            Stop after so many iterations in any case.

        Returns
        -------
        (rows, columns) array
            h; each connected part up to its own constant.
        """
        h = np.zeros_like(rhs)
        residual = rhs.copy()
        laplacian = np.empty_like(rhs)
        direction = np.zeros_like(rhs)
        last_product = 1.0
        target = tolerance * float(np.linalg.norm(rhs))
        for _ in range(max_iterations):
            if float(np.linalg.norm(residual)) <= target:
                break
            # The next direction: the preconditioned residual, conjugate to the last direction.
            preconditioned = self._cycle(0, residual)
            product = float(np.vdot(residual, preconditioned))
            direction *= product / last_product
            direction += preconditioned
            last_product = product
            # The step along it that makes the residual least.
            _apply_laplacian(*self._links[0], direction, laplacian)
            step = product / float(np.vdot(direction, laplacian))
            h += step * direction
            residual -= step * laplacian
        return h

    def _cycle(self, level: int, rhs: FloatArray) -> FloatArray:
        """One symmetric V-cycle from zero: smooth, correct by the coarser grid, smooth back."""
        right, down = self._links[level]
        h, residual, _ = self._memory[level]
        h[:] = 0.0
        # Gauss-Seidel forward: what is left is smooth.
        _smooth_sweep(right, down, rhs, h, True)
        if level + 1 == len(self._links):
            for _ in range(_COARSEST_SWEEPS):
                _smooth_sweep(right, down, rhs, h, False)
                _smooth_sweep(right, down, rhs, h, True)
        else:
            # The residual on the coarser grid, solved there, corrects this one.
            _apply_laplacian(right, down, h, residual)
            np.subtract(rhs, residual, out=residual)
            coarse = self._memory[level + 1][2]
            _restrict_to_coarse(residual, coarse)
            _prolong_to_fine(self._cycle(level + 1, coarse), h, _OVER_CORRECTION)
        # And backward: a symmetric cycle, as conjugate gradients need.
        _smooth_sweep(right, down, rhs, h, False)
        return np.asarray(h)
