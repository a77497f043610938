"""Inverse of a small symmetric positive matrix, compiled."""

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import compile_kernel


@compile_kernel
def invert_in_place(matrix):  # type: ignore[no-untyped-def]
    """Inverse of a symmetric positive matrix in place by Gauss-Jordan; False, and no usable result,
    if it is not one.

    A 36 x 36 matrix takes some 20 us here; on a busy machine the linear algebra library may wait a
    thousand times longer for its threads. A positive matrix needs no pivoting: each pivot is a
    Schur complement, and one below 1e-13 of its diagonal element is only rounding.
    """
    size = matrix.shape[0]
    diagonal = np.diag(matrix).copy()
    for k in range(size):
        pivot = matrix[k, k]
        if not pivot > 1e-13 * diagonal[k]:
            return False
        matrix[k, k] = 1.0
        for j in range(size):
            matrix[k, j] /= pivot
        for i in range(size):
            if i != k:
                factor = matrix[i, k]
                matrix[i, k] = 0.0
                for j in range(size):
                    matrix[i, j] -= factor * matrix[k, j]
    return True
