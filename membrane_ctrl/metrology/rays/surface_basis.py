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
    powers, tables = _evaluate_monomials(x, y, ZERNIKE_DEGREE), _term_tables()
    heights, slopes_x, slopes_y = (table @ powers for table in tables)
    heights -= zernike.at_vertex()[1:, None]
    return (
        np.vstack([heights, bowl]),
        np.vstack([slopes_x, grows * x]),
        np.vstack([slopes_y, grows * y]),
    )


def evaluate_round_basis(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights and slopes (k, n) of the round terms beyond the fit's in radii, each 0 at the
    vertex.
    """
    v, terms = x * x + y * y, terms_beyond_fit.round_series()
    heights = [series.polyval(v, term) for term in terms]
    grows = np.array([2 * series.polyval(v, series.polyder(term)) for term in terms])
    return np.array(heights), grows * x, grows * y


def evaluate_beyond_basis(
    x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights and slopes (k, n) of all terms beyond the fit's in radii, each 0 at the vertex."""
    powers = _evaluate_monomials(x, y, terms_beyond_fit.WAVE_DEGREE)
    waves = [table @ powers for table in _wave_tables()]
    height, of_x, of_y = (
        np.vstack(parts) for parts in zip(evaluate_round_basis(x, y), waves, strict=True)
    )
    return height, of_x, of_y


def _evaluate_monomials(x: FloatArray, y: FloatArray, degree: int) -> FloatArray:
    """x^p y^q, p + q <= degree, p outer, (terms, n)."""
    out, column = [], np.ones_like(x)
    for p in range(degree + 1):
        term = column
        for _ in range(degree + 1 - p):
            out.append(term)
            term = term * y
        column = column * x
    return np.stack(out)


@cache
def _term_tables() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Z_j, dZ_j/dx and dZ_j/dy, j = 2, 3, ..., as coefficients (terms - 1,
    terms) of `_evaluate_monomials`.
    """
    return _flatten_tables(zernike.monomial_table()[1:])


@cache
def _wave_tables() -> tuple[FloatArray, FloatArray, FloatArray]:
    """The waves beyond the fit's and their slopes, as coefficients (waves, k)."""
    return _flatten_tables(terms_beyond_fit.wave_polynomials())


def _flatten_tables(table: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Polynomials (k, degree + 1, degree + 1) and their derivatives along x and y, (k, terms)."""
    degree = table.shape[1] - 1
    p, q = np.array([(p, q) for p in range(degree + 1) for q in range(degree + 1 - p)]).T
    height, of_x, of_y = (
        np.ascontiguousarray(each[:, p, q])
        for each in (table, *(zernike.differentiate_table(table, axis) for axis in (1, 2)))
    )
    return height, of_x, of_y
