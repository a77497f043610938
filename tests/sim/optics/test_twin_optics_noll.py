"""The twin's Zernike terms: order, signs, norm, against an independent implementation."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.polynomial import polyval2d
from prysm.polynomials import noll_to_nm, zernike_nm

from membrane_ctrl.sim.optics.film_shape import noll_orders, polynomial


def _values(j: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    coeffs = np.zeros(j)
    coeffs[j - 1] = 1.0
    return polyval2d(x, y, polynomial(coeffs))


def test_the_low_terms_have_nolls_names() -> None:
    known = {1: (0, 0), 2: (1, 1), 3: (1, -1), 4: (2, 0), 5: (2, -2), 6: (2, 2), 7: (3, -1), 8: (3, 1), 11: (4, 0)}
    assert {j: noll_orders(j) for j in known} == known


def test_the_36_terms_are_all_of_radial_order_seven_or_less() -> None:
    orders = {noll_orders(j) for j in range(1, 37)}
    assert len(orders) == 36
    assert max(n for n, _ in orders) == 7
    assert noll_orders(37)[0] == 8


@pytest.mark.parametrize("j", range(1, 37))
def test_terms_agree_with_prysm(j: int) -> None:
    rng = np.random.default_rng(j)
    rho, theta = np.sqrt(rng.uniform(size=50)), rng.uniform(0.0, 2.0 * np.pi, 50)
    n, m = noll_to_nm(j)
    theirs = zernike_nm(n, m, rho, theta, norm=True)
    ours = _values(j, rho * np.cos(theta), rho * np.sin(theta))
    np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_terms_are_orthonormal_over_the_disc() -> None:
    # Gauss-Legendre in rho^2 and equal angles: exact for polynomials of degree 14
    u, weight = np.polynomial.legendre.leggauss(12)
    theta = 2.0 * np.pi * np.arange(32) / 32
    rho = np.sqrt((u + 1) / 2)
    x, y = np.outer(rho, np.cos(theta)), np.outer(rho, np.sin(theta))
    terms = np.stack([_values(j, x, y) for j in range(1, 37)])
    gram = np.einsum("irt,jrt,r->ij", terms, terms, weight) / (2 * 32)
    np.testing.assert_allclose(gram, np.eye(36), atol=1e-12)


def test_an_index_below_one_is_refused() -> None:
    with pytest.raises(ValueError, match="starts at 1"):
        noll_orders(0)
