"""The twin's Zernike terms: order, signs, norm, against an independent implementation."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.polynomial import polyval2d
from prysm.polynomials import noll_to_nm, zernike_nm

from membrane_ctrl.sim.optics.film_shape import MAX_FILM_TERMS
from membrane_ctrl.sim.optics.zernike_polynomials import noll_orders, zernike_polynomial

FILM_INDICES = range(1, MAX_FILM_TERMS + 1)


def _values(j: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    coeffs = np.zeros(j)
    coeffs[j - 1] = 1.0
    return polyval2d(x, y, zernike_polynomial(coeffs))


def test_the_low_terms_have_nolls_names() -> None:
    known = {
        1: (0, 0),
        2: (1, 1),
        3: (1, -1),
        4: (2, 0),
        5: (2, -2),
        6: (2, 2),
        7: (3, -1),
        8: (3, 1),
        11: (4, 0),
    }
    assert {j: noll_orders(j) for j in known} == known


def test_the_terms_of_a_film_are_all_of_radial_order_13_or_less() -> None:
    orders = {noll_orders(j) for j in FILM_INDICES}
    assert len(orders) == MAX_FILM_TERMS
    assert max(n for n, _ in orders) == 13
    assert noll_orders(MAX_FILM_TERMS + 1)[0] == 14


@pytest.mark.parametrize("j", FILM_INDICES)
def test_terms_agree_with_prysm(j: int) -> None:
    rng = np.random.default_rng(j)
    rho, theta = np.sqrt(rng.uniform(size=50)), rng.uniform(0.0, 2.0 * np.pi, 50)
    n, m = noll_to_nm(j)
    theirs = zernike_nm(n, m, rho, theta, norm=True)
    ours = _values(j, rho * np.cos(theta), rho * np.sin(theta))
    np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_terms_are_orthonormal_over_the_disc() -> None:
    # Gauss-Legendre in rho^2 and equal angles: exact for polynomials of degree 23
    u, weight = np.polynomial.legendre.leggauss(12)
    theta = 2.0 * np.pi * np.arange(32) / 32
    rho = np.sqrt((u + 1) / 2)
    x, y = np.outer(rho, np.cos(theta)), np.outer(rho, np.sin(theta))
    terms = np.stack([_values(j, x, y) for j in FILM_INDICES])
    gram = np.einsum("irt,jrt,r->ij", terms, terms, weight) / (2 * 32)
    np.testing.assert_allclose(gram, np.eye(MAX_FILM_TERMS), atol=1e-12)


def test_an_index_below_one_is_refused() -> None:
    with pytest.raises(ValueError, match="starts at 1"):
        noll_orders(0)
