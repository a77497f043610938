"""Small matrix products as plain loops.

A linear algebra library keeps its own threads, and on a machine that the control loop shares they wait for each
other: products of 40 by 40 then take five times as long as these loops on one core.
"""

from __future__ import annotations

import numpy as np

from membrane_ctrl.metrology.jit import kernel

_BLOCK = 512  # columns that stay in the second-level cache


@kernel
def gram(rows):  # type: ignore[no-untyped-def]
    """rows @ rows.T of a (c, n) array with many columns."""
    count, size = rows.shape
    out = np.zeros((count, count))
    for first in range(0, size, _BLOCK):
        last = min(first + _BLOCK, size)
        for i in range(count):
            for j in range(i + 1):
                total = 0.0
                for k in range(first, last):
                    total += rows[i, k] * rows[j, k]
                out[i, j] += total
    for i in range(count):
        for j in range(i):
            out[j, i] = out[i, j]
    return out


@kernel
def multiply(table, rows):  # type: ignore[no-untyped-def]
    """table @ rows of an (a, b) and a (b, n) array with many columns; zeros in the table cost nothing."""
    out = np.zeros((table.shape[0], rows.shape[1]))
    for i in range(table.shape[0]):
        for j in range(table.shape[1]):
            factor = table[i, j]
            if factor != 0.0:
                for k in range(rows.shape[1]):
                    out[i, k] += factor * rows[j, k]
    return out
