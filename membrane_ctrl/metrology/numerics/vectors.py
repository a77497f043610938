"""Arrays of vectors in space, one a column."""

from collections.abc import Iterator

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

# Columns of a block: its intermediate results stay in the processor's cache
_BLOCK = 1 << 14


def column_blocks(count: int) -> Iterator[slice]:
    """Ranges of columns, one block after the other, for sums over millions of them.

    Parameters
    ----------
    count : int
        Number of columns.

    Yields
    ------
    slice
    """
    for start in range(0, count, _BLOCK):
        yield slice(start, min(start + _BLOCK, count))


def vector_lengths(vectors: FloatArray) -> FloatArray:
    """Lengths (n,) of vectors (3, n).

    Parameters
    ----------
    vectors : (3, n) array

    Returns
    -------
    (n,) array
        As `np.linalg.norm(vectors, axis=0)`, in half of its time.
    """
    square = np.asarray(np.square(vectors[0]))  # one vector alone, too
    for component in vectors[1:]:
        square += np.square(component)
    return np.asarray(np.sqrt(square, out=square))
