"""Heights and slopes of the surface's parameters at points of the unit disc."""

from functools import cache

import numpy as np
from numpy.polynomial import polynomial as series

from membrane_ctrl.metrology.film import hencky_bowl, terms_beyond_fit
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE


def evaluate_basis(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights and slopes of the surface's parameters.

    Parameters
    ----------
    x, y : (n,) arrays
        Points of the unit disc.

    Returns
    -------
    heights, slopes_x, slopes_y : (parameters, n) arrays
        Heights are 0 at the vertex, slopes per radius.
    """
    # The Zernike terms, as sums of monomials.
    powers = _evaluate_monomials(x, y, ZERNIKE_DEGREE)
    heights, slopes_x, slopes_y = (table @ powers for table in _term_tables())
    heights -= zernike.at_vertex()[1:, None]

    # The excess e(v), v = x^2 + y^2, with the slopes 2 e'(v) x and 2 e'(v) y.
    v = x * x + y * y
    excess = hencky_bowl.excess_series() / hencky_bowl.excess_rms()
    excess_height = series.polyval(v, excess) - excess[0]
    excess_slope = 2 * series.polyval(v, series.polyder(excess))
    return (
        np.vstack([heights, excess_height]),
        np.vstack([slopes_x, excess_slope * x]),
        np.vstack([slopes_y, excess_slope * y]),
    )


def evaluate_round_basis(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights and slopes of the round terms beyond the fit's.

    Parameters
    ----------
    x, y : (n,) arrays
        Points of the unit disc.

    Returns
    -------
    heights, slopes_x, slopes_y : (k, n) arrays
        Heights are 0 at the vertex, slopes per radius.
    """
    v = x * x + y * y
    heights = []
    slopes = []
    for term in terms_beyond_fit.round_series():
        heights.append(series.polyval(v, term))
        slopes.append(2 * series.polyval(v, series.polyder(term)))
    radial = np.array(slopes)
    return np.array(heights), radial * x, radial * y


def evaluate_beyond_basis(
    x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights and slopes of all terms beyond the fit's: the round ones, then the waves.

    Parameters
    ----------
    x, y : (n,) arrays
        Points of the unit disc.

    Returns
    -------
    heights, slopes_x, slopes_y : (k, n) arrays
        Slopes per radius.
    """
    round_height, round_x, round_y = evaluate_round_basis(x, y)
    powers = _evaluate_monomials(x, y, terms_beyond_fit.WAVE_DEGREE)
    wave_height, wave_x, wave_y = (table @ powers for table in _wave_tables())
    return (
        np.vstack([round_height, wave_height]),
        np.vstack([round_x, wave_x]),
        np.vstack([round_y, wave_y]),
    )


def _evaluate_monomials(x: FloatArray, y: FloatArray, degree: int) -> FloatArray:
    """x^p y^q, p + q <= degree, p outer, (terms, n)."""
    out = []
    power_x = np.ones_like(x)
    for p in range(degree + 1):
        monomial = power_x
        for _ in range(degree + 1 - p):
            out.append(monomial)
            monomial = monomial * y
        power_x = power_x * x
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
    # Terms x^p y^q with p + q up to the degree, one column each.
    degree = table.shape[1] - 1
    powers = [(p, q) for p in range(degree + 1) for q in range(degree + 1 - p)]
    p, q = np.array(powers).T
    slope_x = zernike.differentiate_table(table, 1)
    slope_y = zernike.differentiate_table(table, 2)
    return (
        np.ascontiguousarray(table[:, p, q]),
        np.ascontiguousarray(slope_x[:, p, q]),
        np.ascontiguousarray(slope_y[:, p, q]),
    )
