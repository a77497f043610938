"""Smooth fields over the picture: computed at some bins, interpolated at all of them.

What a fitted surface does to the rays, such as the change of a screen point per displacement of the
film, varies over the picture as a polynomial of few terms. Tracing the rays of 3000 bins and
fitting polynomials is ten times faster than tracing those of all 140,000.
"""

from collections.abc import Callable

import numpy as np
from numpy.polynomial import chebyshev

from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray

# Total degree of the polynomials in column and row: 91 terms. Ray and film are polynomials of
# degree 7 (36 Zernike terms) to 10; what is left of them is in the tests.
_DEGREE = 12
_SAMPLES = 3000  # bins at which the fields are computed
_REGULAR = 1e-13  # of the largest diagonal: the disc does not fill the square of the polynomials


def interpolate_fields(
    compute: Callable[[IntArray], FloatArray],
    index: IntArray,
    columns: int,
) -> FloatArray:
    """Values of smooth fields at all points.

    Parameters
    ----------
    compute : function
        From numbers (m,) of points to the values (fields, m) there.
    index : (n,) int array
        Bins of the points, ascending.
    columns : int
        Number of bins in a row of the picture.

    Returns
    -------
    (fields, n) array
        Computed directly if there are not many more points than samples.
    """
    if index.size < 2 * _SAMPLES:
        return compute(np.arange(index.size))
    some = np.linspace(0, index.size - 1, _SAMPLES).astype(int)

    # Polynomials on the rectangle around the points, at its columns and rows.
    row, column = np.divmod(index, columns)
    row -= row.min()
    column -= column.min()
    by_row = _polynomials(int(row.max()) + 1)
    by_column = _polynomials(int(column.max()) + 1)

    # Least squares for their amplitudes at the samples.
    allowed = _allowed_terms()
    products = by_row[row[some], :, None] * by_column[column[some], None, :]
    design = products[:, allowed]
    normal = design.T @ design
    normal[np.diag_indices_from(normal)] += _REGULAR * normal.max()
    values = compute(some)
    amplitudes = np.linalg.solve(normal, design.T @ values.T).T

    # All bins of the rectangle at once, then those of the points.
    place = row * len(by_column) + column
    out = np.empty((len(values), index.size))
    for field, terms in zip(out, amplitudes, strict=True):
        table = np.zeros(allowed.shape)
        table[allowed] = terms
        np.take((by_row @ table @ by_column.T).ravel(), place, out=field)
    return out


def _polynomials(count: int) -> FloatArray:
    """Chebyshev polynomials (count, degree + 1) at evenly spaced places."""
    return np.asarray(chebyshev.chebvander(np.linspace(-1, 1, count), _DEGREE))


def _allowed_terms() -> BoolArray:
    """Products (degree + 1, degree + 1) of row and column polynomials up to the total degree."""
    degree = np.arange(_DEGREE + 1)
    return np.asarray(degree[:, None] + degree <= _DEGREE)
