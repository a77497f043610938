"""Square cells of bins, over each of which what changes slowly over the mirror is a plane.

The functions after `Cells` do the same for one block, compiled. One small loop a function, and a
block's rows in one array: so the compiler can prove that nothing overlaps, and finds vector
instructions on any processor. A block's planes fit the second cache.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import compile_kernel
from membrane_ctrl.model.arrays import AnyArray, BoolArray, IntArray, Singles

_SIDE = 4  # bins along a cell's side: planes are 1 % off for the highest terms at the rim
CELL_BINS = _SIDE**2
BLOCK_CELLS = 64  # cells of a block
BLOCK_BINS = CELL_BINS * BLOCK_CELLS  # 1024: nine rows of them fit the first cache
_LEAST_SQUARE = np.float32(1e-3)  # of the offsets of a cell whose bins are in one row


@dataclass(frozen=True)
class Cells:
    """Squares of bins, N of them, over each of which what changes slowly is a plane.

    64 cells are a block: their first bins, then their second ones, and so on, so that loops over a
    block use vector units. A cell with fewer bins repeats one, as the last block repeats a cell;
    repeated bins have the weight 0 (`of`).

    Attributes
    ----------
    offset : (N / 64, 2, 16, 64) array
        Column and row of the bins, from the mean of their cell's.
    """

    offset: Singles

    @staticmethod
    def from_bins(index: IntArray, columns: int) -> "tuple[IntArray, BoolArray, Cells]":
        """Arrange bins in cells.

        Parameters
        ----------
        index : (m,) int array
            Numbers of the bins, row by row.
        columns : int
            Bins of a row.

        Returns
        -------
        index : (n,) int array
            The bins in the order of the cells, with repetitions.
        counted : (n,) bool array
            Whether each counts, or repeats another one.
        cells : Cells
        """
        # Bins sorted by their square; where each square begins, and how many bins it has.
        square = index // columns // _SIDE * columns + index % columns // _SIDE
        order = np.argsort(square, kind="stable")
        _, starts, counts = np.unique(square[order], return_index=True, return_counts=True)

        # The bins of each cell (cells, 16); missing ones repeat its first bin.
        counted = counts[:, None] > np.arange(CELL_BINS)
        bins = starts[:, None] + np.arange(CELL_BINS) * counted

        # Whole blocks (blocks, 16, 64); missing cells repeat the last one.
        missing = (0, -len(starts) % BLOCK_CELLS), (0, 0)
        bins = np.pad(bins, missing, "edge")
        counted = np.pad(counted, missing)
        bins = bins.reshape(-1, BLOCK_CELLS, CELL_BINS).swapaxes(1, 2)
        counted = counted.reshape(-1, BLOCK_CELLS, CELL_BINS).swapaxes(1, 2)
        index = index[order][bins]

        # Places of the bins relative to the middle of their cell.
        place = np.stack([index % columns, index // columns], axis=1)
        middle = place.mean(axis=2, keepdims=True)
        offset = (place - middle).astype(np.float32, order="C")
        return index.ravel(), counted.ravel(), Cells(offset)

    @cached_property
    def _offsets(self) -> Singles:
        """Offsets (2, n) of the bins."""
        return self.offset.swapaxes(0, 1).reshape(2, -1)

    def sum_cells(self, values: AnyArray) -> AnyArray:
        """Sum values of bins over the cells.

        Parameters
        ----------
        values : (..., n) array

        Returns
        -------
        (..., N) array
        """
        lead = values.shape[:-1]
        blocks = len(self.offset)
        of_blocks = values.reshape(*lead, blocks, CELL_BINS, BLOCK_CELLS).sum(axis=-2)
        return np.asarray(of_blocks.reshape(*lead, blocks * BLOCK_CELLS))

    def sum_moments(self, values: AnyArray) -> AnyArray:
        """Sums (..., 3, N) over the cells, of values of bins (..., n) times 1 and their offsets.

        These are the right-hand side of a least squares for a plane in each cell.
        """
        by_offset = [self.sum_cells(values * offset) for offset in self._offsets]
        return np.stack([self.sum_cells(values), *by_offset], axis=-2)

    def repeat_over_bins(self, values: AnyArray) -> AnyArray:
        """For each bin (..., n) the value of its cell (..., N)."""
        lead = values.shape[:-1]
        blocks = len(self.offset)
        repeated = np.repeat(values.reshape(*lead, blocks, 1, BLOCK_CELLS), CELL_BINS, axis=-2)
        return repeated.reshape(*lead, blocks * BLOCK_BINS)

    def evaluate_planes(self, planes: AnyArray) -> AnyArray:
        """Values (..., n) of the bins on planes (..., 3, N) of the cells."""
        mean, along_u, along_v = self.repeat_over_bins(np.moveaxis(planes, -2, 0))
        u, v = self._offsets
        return np.asarray(mean + along_u * u + along_v * v)

    def fit_planes(self, values: AnyArray) -> Singles:
        """Fit a plane to the values of each cell's bins.

        Parameters
        ----------
        values : (..., n) array

        Returns
        -------
        (..., 3, N) array
            Mean, and slopes along columns and rows, of each cell.
        """
        # Normal equations of each cell, kept regular where all bins are in one row.
        basis = np.stack([np.ones_like(self._offsets[0]), *self._offsets])
        normal = self.sum_moments(basis)
        normal[[1, 2], [1, 2]] += _LEAST_SQUARE
        inverse = np.linalg.inv(normal.transpose(2, 0, 1))
        fitted = np.einsum("qij,...jq->...iq", inverse, self.sum_moments(values))
        return np.asarray(fitted, np.float32, order="C")

    def arrange_blocks(self, *planes: Singles) -> Singles:
        """Planes, each (k, 3, N), block by block (N / 64, sum of k, 3 x 64)."""
        blocks = len(self.offset)
        every = np.concatenate(planes).reshape(-1, 3, blocks, BLOCK_CELLS)
        by_block = np.ascontiguousarray(every.transpose(2, 0, 1, 3))
        return by_block.reshape(blocks, -1, 3 * BLOCK_CELLS)


@compile_kernel
def combine_planes(slow, factors, start, planes):  # type: ignore[no-untyped-def]
    """Sum of planes of a block's cells, for its surface or its light.

    Parameters
    ----------
    slow : (k, 3 x 64) array
        A plane over each cell for each of k parameters: level, slope along x, slope along y.
    factors : (k,) array
        The parameters.
    start : float
        Level without them.
    planes : (3 x 64,) array
        Gets the sum.
    """
    planes[:BLOCK_CELLS] = start
    planes[BLOCK_CELLS:] = 0
    for k in range(factors.size):
        for q in range(planes.size):
            planes[q] += factors[k] * slow[k, q]


@compile_kernel
def project_planes(slow, planes, out):  # type: ignore[no-untyped-def]
    """Add the products of planes with those of parameters: the transpose of `combine_planes`.

    Parameters
    ----------
    slow : (k, 3 x 64) array
        As in `combine_planes`.
    planes : (3 x 64,) array
        Moments over the cells.
    out : (k,) array
        Gets the products in addition.
    """
    for k in range(out.size):
        total = np.float32(0)
        for q in range(planes.size):
            total += slow[k, q] * planes[q]
        out[k] += total


@compile_kernel
def spread_planes(planes, offset, out):  # type: ignore[no-untyped-def]
    """Values of a block's bins on the planes of its cells.

    Parameters
    ----------
    planes : (3 x 64,) array
        Level and slopes of each cell.
    offset : (2, 16, 64) array
        Place of each bin in its cell.
    out : (16, 64) array
        Gets the values.
    """
    for j in range(CELL_BINS):
        for q in range(BLOCK_CELLS):
            out[j, q] = (
                planes[q]
                + planes[BLOCK_CELLS + q] * offset[0, j, q]
                + planes[2 * BLOCK_CELLS + q] * offset[1, j, q]
            )


@compile_kernel
def compute_moments(values, offset, planes):  # type: ignore[no-untyped-def]
    """Moments of values over a block's cells: the transpose of `spread_planes`.

    Parameters
    ----------
    values : (16, 64) array
        Of the bins.
    offset : (2, 16, 64) array
        Place of each bin in its cell.
    planes : (3 x 64,) array
        Gets the sums, and those weighted with either offset.
    """
    planes[:] = 0
    for j in range(CELL_BINS):
        for q in range(BLOCK_CELLS):
            planes[q] += values[j, q]
            planes[BLOCK_CELLS + q] += values[j, q] * offset[0, j, q]
            planes[2 * BLOCK_CELLS + q] += values[j, q] * offset[1, j, q]
