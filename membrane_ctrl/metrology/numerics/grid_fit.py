"""Least squares of Zernike terms over the cells of a grid that a mask selects."""

from collections.abc import Sequence

import numpy as np
from numpy.polynomial.legendre import legvander, poly2leg

from membrane_ctrl.metrology.numerics.zernike import radial_polynomial
from membrane_ctrl.model.arrays import BoolArray, FloatArray

_SEPARABLE = 1e-12  # eigenvalue over the largest, below which the mask does not separate terms


class GridFit:
    """Least squares of terms over the cells of a grid that a mask selects.

    Parameters
    ----------
    x, mask : (W,), (H, W) arrays
        Middle of the cells, in radii of the disc, and the cells to use; rows along y.
    orders : sequence of (n, m)
        Terms, without normalisation.
    y : (H,) array, optional
        As `x`, which it is by default.
    """

    def __init__(
        self,
        x: FloatArray,
        mask: BoolArray,
        orders: Sequence[tuple[int, int]],
        y: FloatArray | None = None,
    ) -> None:
        if y is None:
            y = x
        # The terms as sums of products of Legendre polynomials, which are well conditioned:
        # coefficients (terms, degree + 1, degree + 1).
        degree = max(n for n, _ in orders)
        rows = []
        for power in np.eye(degree + 1):
            series = poly2leg(power)
            rows.append(np.pad(series, (0, degree + 1 - series.size)))
        to_legendre = np.stack(rows)
        terms = []
        for n, m in orders:
            in_powers = radial_polynomial(n, m, degree)
            terms.append(to_legendre.T @ in_powers @ to_legendre)
        self._terms = np.stack(terms)

        # Legendre polynomials (points, degree + 1) along the columns and the rows.
        self._x = legvander(x, degree)
        self._y = legvander(y, degree)
        self._mask = mask

        # The Gram matrix of the terms over the mask, from moments of products of polynomials.
        pairs_x = np.einsum("ia,ib->iab", self._x, self._x)
        pairs_y = np.einsum("ia,ib->iab", self._y, self._y)
        moments = np.einsum("iac,ij,jbd->acbd", pairs_y, mask.astype(float), pairs_x, optimize=True)
        gram = np.einsum("kba,acbd,ldc->kl", self._terms, moments, self._terms, optimize=True)
        # Its pseudo-inverse: terms that the mask does not separate share their value.
        self._solver = np.linalg.pinv(gram, rcond=_SEPARABLE, hermitian=True)

    def coefficients(self, values: FloatArray) -> FloatArray:
        """Fit a map.

        Parameters
        ----------
        values : (H, W) array
            The map; cells outside the mask are not read.

        Returns
        -------
        (terms,) array
            Coefficients, in the map's unit.
        """
        inside = np.where(self._mask, values, 0.0)
        moments = self._y.T @ inside @ self._x
        right = np.einsum("kba,ab->k", self._terms, moments)
        return np.asarray(self._solver @ right)

    def values(self, coefficients: FloatArray) -> FloatArray:
        """Map (H, W) of the terms, also outside the mask."""
        inner = np.tensordot(coefficients, self._terms, axes=1).T
        return np.asarray(self._y @ inner @ self._x.T)
