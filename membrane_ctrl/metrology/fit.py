"""Normal equations of the slope fit, made from moments (the paper's eqs. for D, G and A).

With D the derivatives of the basis at the points and g the measured slopes, A = (D^T D)^-1 D^T g. All derivatives of
the 36 Zernike terms are polynomials of degree 6 in x and y, so D^T g and D^T D follow exactly from sums of monomials
over the points; no 2N x 36 matrix is ever built. As printed, D^T D is singular: piston has no slope. Here piston's
column is left out and its place is taken by the Hencky excess, scaled to unit RMS like the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology import kernels
from membrane_ctrl.metrology.surface import PARAMETERS
from membrane_ctrl.metrology.zernike import DEGREE, differentiate, monomial_table

FloatArray = NDArray[np.float64]

_M = kernels.SLOPE_MONOMIALS
_POWERS = [(p, q) for p in range(DEGREE) for q in range(DEGREE - p)]  # in the kernels' order
_PRODUCT_POWERS = [(p, q) for p in range(kernels.PRODUCT_DEGREE + 1) for q in range(kernels.PRODUCT_DEGREE + 1 - p)]


@cache
def slope_tables() -> tuple[FloatArray, FloatArray]:
    """dZ_j/dx and dZ_j/dy for j = 2..36 as monomial coefficients, (35, 28) each, on the unit disc."""
    rows, columns = np.array(_POWERS).T
    tables = [differentiate(monomial_table(), axis)[1:, rows, columns] for axis in (1, 2)]
    return tables[0], tables[1]


@cache
def _product_index() -> NDArray[np.int64]:
    """Where the product of monomials k and l stands among the product moments, (28, 28)."""
    place = {power: k for k, power in enumerate(_PRODUCT_POWERS)}
    return np.array([[place[a[0] + b[0], a[1] + b[1]] for b in _POWERS] for a in _POWERS])


@dataclass(frozen=True)
class NormalMatrix:
    """D^T W D, apart for x and y slopes, and its inverse.

    Attributes
    ----------
    x, y : (36, 36) arrays
        Shares of the x and of the y slopes, in 1/mm^2 times weight.
    inverse : (36, 36) array
        Of their sum. The condition number is below 1000, and what rounding leaves the next step takes out.
    """

    x: FloatArray
    y: FloatArray
    inverse: FloatArray

    @classmethod
    def from_products(cls, products: FloatArray, radius_mm: float) -> NormalMatrix:
        """From the moments of `kernels.product_sums`. Raises ValueError if the points do not determine a surface."""
        x, y = _assemble(products, radius_mm)
        inverse = x + y
        if not kernels.invert(inverse):
            raise ValueError("the measured points do not determine the 36 parameters of the surface")
        return cls(x, y, inverse)

    def solve(self, right: FloatArray) -> FloatArray:
        """(D^T W D)^-1 times `right`."""
        return np.asarray(self.inverse @ right)

    def condition(self) -> float:
        """Condition number of D^T W D."""
        return float(np.linalg.cond(self.x + self.y))


def _assemble(products: FloatArray, radius_mm: float) -> tuple[FloatArray, FloatArray]:
    count = kernels.PRODUCT_MONOMIALS
    hankel = products[:count][_product_index()]
    crosses = products[count : count + _M], products[count + _M : count + 2 * _M]
    out = []
    # the excess' slopes are 2 x e'(v) / R and 2 y e'(v) / R
    for table, cross, square in zip(slope_tables(), crosses, products[-2:], strict=True):
        matrix = np.empty((PARAMETERS, PARAMETERS))
        matrix[:-1, :-1] = table @ hankel @ table.T
        matrix[-1, :-1] = matrix[:-1, -1] = 2 * (table @ cross)
        matrix[-1, -1] = 4 * square
        out.append(matrix / radius_mm**2)
    return out[0], out[1]


def right_side(sums: FloatArray, radius_mm: float) -> FloatArray:
    """D^T W r of the x and of the y slopes, (2, 36), from the moments of `kernels.residual_sums`."""
    out = np.empty((2, PARAMETERS))
    for axis, table in enumerate(slope_tables()):
        out[axis, :-1] = table @ sums[axis * _M : (axis + 1) * _M]
        out[axis, -1] = 2 * sums[2 * _M + axis]
    return out / radius_mm


def residual_rms(sums: FloatArray, right: FloatArray, normal: NormalMatrix, delta: FloatArray) -> tuple[float, float]:
    """RMS of the x and of the y slopes' residual after the step `delta`, without another pass over the points.

    |r - D delta|^2 = |r|^2 - 2 delta D^T r + delta D^T D delta, each sum weighted.
    """
    weight = sums[-1]
    if not weight > 0:
        return float("nan"), float("nan")
    squares = [
        sums[2 * _M + 2 + axis] - 2 * delta @ right[axis] + delta @ matrix @ delta
        for axis, matrix in enumerate((normal.x, normal.y))
    ]
    x, y = (float(np.sqrt(max(square, 0.0) / weight)) for square in squares)
    return x, y
