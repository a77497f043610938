"""Sums over groups of columns, compiled."""

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import compile_kernel


@compile_kernel
def sum_by_group(number, values, count):  # type: ignore[no-untyped-def]
    """Sums over groups of columns.

    Parameters
    ----------
    number : (n,) int array
        Group of each column, from 0.
    values : (k, n) array
    count : int
        Number of groups.

    Returns
    -------
    (k, count) array
    """
    out = np.zeros((values.shape[0], count))
    for k in range(values.shape[0]):
        for p in range(number.size):
            out[k, number[p]] += values[k, p]
    return out
