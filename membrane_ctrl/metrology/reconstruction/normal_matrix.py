"""Normal equations of the slope fit, made from moments (the paper's eqs. for D, G and A).

With D the derivatives of the basis at the points and g the measured slopes, A = (D^T D)^-1 D^T g.
All derivatives of the Zernike terms are polynomials of one degree less in x and y, so D^T g and
D^T D follow exactly from sums of monomials over the points; no matrix of 2N rows is ever built. As
printed, D^T D is singular: piston has no slope. Here the Hencky excess replaces piston's column,
scaled to unit RMS like the others.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from membrane_ctrl.metrology.numerics import matrix_inverse, zernike
from membrane_ctrl.metrology.rays import kernels
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer
from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.model.arrays import FloatArray, IntArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE

_M = kernels.SLOPE_MONOMIALS
# Exponents (p, q) of x^p y^q: of the slopes, and of the products of two slopes; in the kernels'
# order.
_POWERS = [(p, q) for p in range(ZERNIKE_DEGREE) for q in range(ZERNIKE_DEGREE - p)]
_PRODUCT_POWERS = [
    (p, q) for p in range(kernels.PRODUCT_DEGREE + 1) for q in range(kernels.PRODUCT_DEGREE + 1 - p)
]


@cache
def slope_tables() -> tuple[FloatArray, FloatArray]:
    """dZ_j/dx and dZ_j/dy for j = 2, 3, ... as monomial coefficients, (terms - 1, SLOPE_MONOMIALS)
    each, on the unit disc."""
    p, q = np.array(_POWERS).T
    slope_x = zernike.differentiate_table(zernike.monomial_table(), 1)
    slope_y = zernike.differentiate_table(zernike.monomial_table(), 2)
    return slope_x[1:, p, q], slope_y[1:, p, q]


@cache
def _product_index() -> IntArray:
    """Index of the product of monomials k and l among the product moments, a square matrix."""
    place = {power: k for k, power in enumerate(_PRODUCT_POWERS)}
    rows = []
    for p_k, q_k in _POWERS:
        rows.append([place[p_k + p_l, q_k + q_l] for p_l, q_l in _POWERS])
    return np.array(rows)


@dataclass(frozen=True)
class NormalMatrix:
    """D^T W D, separately for x and y slopes, and the inverse of their sum.

    Attributes
    ----------
    x, y : (parameters, parameters) arrays
        Shares of the x and of the y slopes, in 1/mm^2 times weight.
    inverse : (parameters, parameters) array
        Inverse of their sum. The condition number is below 1000, and the next step corrects what
        rounding leaves.
    """

    x: FloatArray
    y: FloatArray
    inverse: FloatArray

    @classmethod
    def from_points(cls, tracer: Tracer, points: Points) -> "NormalMatrix":
        """Return D^T W D at the present places of points.

        Parameters
        ----------
        tracer : Tracer
        points : Points
            With their weights W.

        Raises
        ------
        ValueError
            As `from_products`.
        """
        return cls.from_products(tracer.product_sums(points), tracer.radius_mm)

    @classmethod
    def from_products(cls, products: FloatArray, radius_mm: float) -> "NormalMatrix":
        """Assemble and invert the matrix.

        Parameters
        ----------
        products : (PRODUCTS,) array
            Moments of `kernels.product_sums`.
        radius_mm : float
            Radius of the terms' disc.

        Returns
        -------
        NormalMatrix

        Raises
        ------
        ValueError
            The points do not determine a surface.
        """
        x, y = _assemble_matrix(products, radius_mm)
        inverse = x + y
        if not matrix_inverse.invert_in_place(inverse):
            raise ValueError(
                f"the measured points do not determine the {PARAMETERS} parameters of the surface"
            )
        return cls(x, y, inverse)

    def solve(self, right: FloatArray) -> FloatArray:
        """(D^T W D)^-1 times `right` (parameters,): the least squares of the paper's eq. 19."""
        return np.asarray(self.inverse @ right)


def _assemble_matrix(products: FloatArray, radius_mm: float) -> tuple[FloatArray, FloatArray]:
    """D^T W D of the x and of the y slopes, (parameters, parameters) each, from the moments of
    `kernels.product_sums`.
    """
    # The products in the order in which the kernel returns them: sum w x^p y^q as a matrix over
    # pairs of monomials, sum w e'(v) x x^p y^q and sum w e'(v) y x^p y^q, and their squares.
    count = kernels.PRODUCT_MONOMIALS
    pair_moments = products[:count][_product_index()]
    excess_x = products[count : count + _M]
    excess_y = products[count + _M : count + 2 * _M]
    squares = products[-2:]

    # Slopes of the terms are sums of monomials; those of the excess are 2 e'(v) x / R and
    # 2 e'(v) y / R.
    out = []
    for table, moments, square in zip(slope_tables(), (excess_x, excess_y), squares, strict=True):
        matrix = np.empty((PARAMETERS, PARAMETERS))
        matrix[:-1, :-1] = table @ pair_moments @ table.T
        by_excess = 2 * (table @ moments)
        matrix[-1, :-1] = by_excess
        matrix[:-1, -1] = by_excess
        matrix[-1, -1] = 4 * square
        out.append(matrix / radius_mm**2)
    return out[0], out[1]


def right_side(sums: FloatArray, radius_mm: float) -> FloatArray:
    """Right-hand side of the least squares, without the matrix D of all points.

    Parameters
    ----------
    sums : (SUMS,) array
        Moments of `kernels.residual_sums`.
    radius_mm : float
        Radius of the terms' disc.

    Returns
    -------
    (2, parameters) array
        D^T W r of the x and of the y slopes.
    """
    out = np.empty((2, PARAMETERS))
    for axis, table in enumerate(slope_tables()):
        # Terms: their slopes are sums of monomials. Excess: 2 e'(v) x / R, 2 e'(v) y / R.
        moments = sums[axis * _M : (axis + 1) * _M]
        out[axis, :-1] = table @ moments
        out[axis, -1] = 2 * sums[2 * _M + axis]
    return out / radius_mm


def residual_rms(
    sums: FloatArray, right: FloatArray, normal: NormalMatrix, delta: FloatArray
) -> tuple[float, float]:
    """RMS of the slopes' residual after a step, without another pass over the points.

    |r - D delta|^2 = |r|^2 - 2 delta D^T r + delta D^T D delta, each sum weighted.

    Parameters
    ----------
    sums : (SUMS,) array
        Moments of `kernels.residual_sums` before the step.
    right : (2, parameters) array
        `right_side` of them.
    normal : NormalMatrix
        D^T W D.
    delta : (parameters,) array
        The step, in mm.

    Returns
    -------
    (float, float)
        Of the x and of the y slopes; NaN without weight.
    """
    weight = sums[-1]
    if not weight > 0:
        return float("nan"), float("nan")
    rms = []
    for axis, matrix in enumerate((normal.x, normal.y)):
        before = sums[2 * _M + 2 + axis]  # |r|^2
        square = before - 2 * delta @ right[axis] + delta @ matrix @ delta
        rms.append(float(np.sqrt(max(square, 0.0) / weight)))
    return rms[0], rms[1]
