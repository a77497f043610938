"""Square cells of bins, over each of which what changes slowly over the mirror is a plane.

The functions after `Cells` do the same for one block, compiled. One small loop a function, and a
block's rows in one array: so the compiler knows that nothing overlaps, and finds vector
instructions on any processor. A block's planes fit the second cache.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import compile_kernel
from membrane_ctrl.model.arrays import AnyArray, BoolArray, IntArray, Singles

_SIDE = 4  # bins along a cell's side: planes are 1 % off for the highest terms at the rim
CELL_BINS, BLOCK_CELLS = (
    _SIDE**2,
    64,
)  # a block of cells has 1024 bins: nine rows of them fit the first cache
BLOCK_BINS = CELL_BINS * BLOCK_CELLS


@dataclass(frozen=True)
class Cells:
    """Squares of bins, N of them, over each of which what changes slowly is a plane.

    64 cells are a block: their first bins, then their second ones, and so on, so that loops over a
    block use vector units. A cell with fewer bins repeats one, as the last block repeats a cell;
    what is repeated counts once, because its weight is 0 (`of`).
    """

    offset: Singles  # (N / 64, 2, 16, 64): of the bins, from the mean of their cell's

    @staticmethod
    def of(index: IntArray, columns: int) -> "tuple[IntArray, BoolArray, Cells]":
        """Bins (n,) in the order of the cells, whether each counts, and the cells."""
        square = index // columns // _SIDE * columns + index % columns // _SIDE
        order = np.argsort(square, kind="stable")
        _, starts, counts = np.unique(square[order], return_index=True, return_counts=True)
        counted = counts[:, None] > np.arange(CELL_BINS)
        first = starts[:, None] + np.arange(CELL_BINS) * counted
        more = (0, -len(starts) % BLOCK_CELLS), (0, 0)
        padded = np.pad(first, more, "edge"), np.pad(counted, more)
        blocks, counted = (
            each.reshape(-1, BLOCK_CELLS, CELL_BINS).swapaxes(1, 2) for each in padded
        )
        index = index[order][blocks]
        at = np.stack([index % columns, index // columns], axis=1)
        offset = (at - at.mean(axis=2, keepdims=True)).astype(np.float32, order="C")
        return index.ravel(), counted.ravel(), Cells(offset)

    @cached_property
    def _offsets(self) -> Singles:
        """(2, n)."""
        return self.offset.swapaxes(0, 1).reshape(2, -1)

    def sums(self, values: AnyArray) -> AnyArray:
        """Of the cells (..., N) of bins (..., n)."""
        lead, blocks = values.shape[:-1], len(self.offset)
        return np.asarray(
            values.reshape(*lead, blocks, CELL_BINS, BLOCK_CELLS)
            .sum(axis=-2)
            .reshape(*lead, blocks * BLOCK_CELLS)
        )

    def moments(self, values: AnyArray) -> AnyArray:
        """Sums (..., 3, N) of values of bins (..., n) times 1 and their offsets."""
        return np.stack(
            [self.sums(values), *(self.sums(values * one) for one in self._offsets)], axis=-2
        )

    def each(self, values: AnyArray) -> AnyArray:
        """Of the bins (..., n) those of their cells (..., N)."""
        lead, blocks = values.shape[:-1], len(self.offset)
        repeated = np.repeat(values.reshape(*lead, blocks, 1, BLOCK_CELLS), CELL_BINS, axis=-2)
        return repeated.reshape(*lead, blocks * BLOCK_BINS)

    def spread(self, planes: AnyArray) -> AnyArray:
        """Values (..., n) of the bins on planes (..., 3, N) of the cells."""
        mean, along_u, along_v = self.each(np.moveaxis(planes, -2, 0))
        u, v = self._offsets
        return np.asarray(mean + along_u * u + along_v * v)

    def planes(self, values: AnyArray) -> Singles:
        """The planes (..., 3, N) that fit values of bins (..., n) best."""
        weights = self.moments(np.stack([np.ones_like(self._offsets[0]), *self._offsets]))
        weights[[1, 2], [1, 2]] += np.float32(1e-3)  # bins in a row
        inverse = np.linalg.inv(weights.transpose(2, 0, 1))
        return np.asarray(
            np.einsum("qij,...jq->...iq", inverse, self.moments(values)), np.float32, order="C"
        )

    def blocks(self, *planes: Singles) -> Singles:
        """Planes, each (k, 3, N), block by block (N / 64, sum of k, 3 x 64)."""
        every = np.concatenate(planes).reshape(-1, 3, len(self.offset), BLOCK_CELLS)
        return np.ascontiguousarray(every.transpose(2, 0, 1, 3)).reshape(
            len(self.offset), -1, 3 * BLOCK_CELLS
        )


@compile_kernel
def combine_planes(slow, factors, start, planes):  # type: ignore[no-untyped-def]
    """Planes (3 x 64) of a block's cells: of level `start`, plus (k, 3 x 64) times their factors
    (k,).
    """
    planes[:BLOCK_CELLS], planes[BLOCK_CELLS:] = start, 0
    for k in range(factors.size):
        for q in range(planes.size):
            planes[q] += factors[k] * slow[k, q]


@compile_kernel
def project_planes(slow, planes, out):  # type: ignore[no-untyped-def]
    """Add the products (k,) of planes (3 x 64) with others (k, 3 x 64)."""
    for k in range(out.size):
        total = np.float32(0)
        for q in range(planes.size):
            total += slow[k, q] * planes[q]
        out[k] += total


@compile_kernel
def spread_planes(planes, offset, out):  # type: ignore[no-untyped-def]
    """Values (16, 64) of a block's bins on the planes of its cells."""
    for j in range(CELL_BINS):
        for q in range(BLOCK_CELLS):
            out[j, q] = (
                planes[q]
                + planes[BLOCK_CELLS + q] * offset[0, j, q]
                + planes[2 * BLOCK_CELLS + q] * offset[1, j, q]
            )


@compile_kernel
def compute_moments(values, offset, planes):  # type: ignore[no-untyped-def]
    """Moments of values (16, 64) over a block's cells."""
    planes[:] = 0
    for j in range(CELL_BINS):
        for q in range(BLOCK_CELLS):
            planes[q] += values[j, q]
            planes[BLOCK_CELLS + q] += values[j, q] * offset[0, j, q]
            planes[2 * BLOCK_CELLS + q] += values[j, q] * offset[1, j, q]
