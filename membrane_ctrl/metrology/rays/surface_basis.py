"""Heights and slopes of the surface's parameters at points of the unit disc."""

from functools import cache

import numpy as np
from numpy.polynomial import polynomial as series

from membrane_ctrl.metrology.film import hencky_bowl, terms_beyond_fit
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE


def evaluate_basis(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights and slopes (parameters, n) of the surface's parameters in radii, each 0 at the
    vertex.
    """
    v = x * x + y * y
    excess = hencky_bowl.excess_series() / hencky_bowl.excess_rms()
    bowl = series.polyval(v, excess) - excess[0]
    grows = 2 * series.polyval(v, series.polyder(excess))
    powers, tables = _evaluate_monomials(x, y), _term_tables()
    heights, slopes_x, slopes_y = (table @ powers for table in tables)
    heights -= zernike.at_vertex()[1:, None]
    return (
        np.vstack([heights, bowl]),
        np.vstack([slopes_x, grows * x]),
        np.vstack([slopes_y, grows * y]),
    )


def evaluate_round_basis(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights and slopes (k, n) of the terms of `film_law.BEYOND` in radii,
    each 0 at the vertex.
    """
    v, terms = x * x + y * y, terms_beyond_fit.beyond_series()
    heights = [series.polyval(v, term) for term in terms]
    grows = np.array([2 * series.polyval(v, series.polyder(term)) for term in terms])
    return np.array(heights), grows * x, grows * y


def _evaluate_monomials(x: FloatArray, y: FloatArray) -> FloatArray:
    """x^p y^q, p + q <= ZERNIKE_DEGREE, p outer, (terms, n)."""
    out, column = [], np.ones_like(x)
    for p in range(ZERNIKE_DEGREE + 1):
        term = column
        for _ in range(ZERNIKE_DEGREE + 1 - p):
            out.append(term)
            term = term * y
        column = column * x
    return np.stack(out)


@cache
def _term_tables() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Z_j, dZ_j/dx and dZ_j/dy, j = 2, 3, ..., as coefficients (terms - 1,
    terms) of `_evaluate_monomials`.
    """
    p, q = np.array(
        [(p, q) for p in range(ZERNIKE_DEGREE + 1) for q in range(ZERNIKE_DEGREE + 1 - p)]
    ).T
    table = zernike.monomial_table()
    height, of_x, of_y = (
        t[1:, p, q] for t in (table, *(zernike.differentiate_table(table, axis) for axis in (1, 2)))
    )
    return np.ascontiguousarray(height), np.ascontiguousarray(of_x), np.ascontiguousarray(of_y)
