"""Zernike terms against prysm, and their derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from prysm.polynomials import noll_to_nm, zernike_nm

from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model.zernike_terms import NOLL_INDICES, ZERNIKE_DEGREE, ZERNIKE_TERMS

RNG = np.random.default_rng(3)
RHO, THETA = np.sqrt(RNG.uniform(0, 1, 200)), RNG.uniform(-np.pi, np.pi, 200)
X, Y = RHO * np.cos(THETA), RHO * np.sin(THETA)


@pytest.mark.parametrize("j", NOLL_INDICES)
def test_term_is_prysms(j: int) -> None:
    n, m = noll_to_nm(j)
    assert zernike.noll_orders(j) == (n, m)
    assert zernike.evaluate_terms(X, Y)[j - 1] == pytest.approx(
        zernike_nm(n, m, RHO, THETA, norm=True), abs=1e-12
    )


def test_the_terms_are_all_up_to_a_radial_order() -> None:
    assert zernike.noll_orders(ZERNIKE_TERMS)[0] == ZERNIKE_DEGREE
    assert zernike.noll_orders(ZERNIKE_TERMS + 1)[0] == ZERNIKE_DEGREE + 1
    assert (
        np.linalg.matrix_rank(zernike.monomial_table().reshape(ZERNIKE_TERMS, -1)) == ZERNIKE_TERMS
    )


def test_terms_are_orthonormal_over_the_disc() -> None:
    nodes, weights = np.polynomial.legendre.leggauss(ZERNIKE_DEGREE + 3)
    rho, theta = np.sqrt((nodes + 1) / 2), 2 * np.pi * np.arange(32) / 32
    z = zernike.evaluate_terms(np.outer(rho, np.cos(theta)), np.outer(rho, np.sin(theta)))
    gram = np.einsum("jab,kab,a->jk", z, z, weights / 64)
    assert gram == pytest.approx(np.eye(ZERNIKE_TERMS), abs=1e-12)


def test_gradients_are_those_of_the_values() -> None:
    h = 1e-4
    gx, gy = zernike.evaluate_gradients(X, Y)
    assert gx == pytest.approx(
        (zernike.evaluate_terms(X + h, Y) - zernike.evaluate_terms(X - h, Y)) / (2 * h), abs=1e-4
    )
    assert gy == pytest.approx(
        (zernike.evaluate_terms(X, Y + h) - zernike.evaluate_terms(X, Y - h)) / (2 * h), abs=1e-4
    )


def test_vertex_and_rim_means() -> None:
    theta = 2 * np.pi * np.arange(64) / 64
    assert zernike.at_vertex() == pytest.approx(
        zernike.evaluate_terms(np.zeros(1), np.zeros(1))[:, 0]
    )
    assert zernike.at_rim() == pytest.approx(
        zernike.evaluate_terms(np.cos(theta), np.sin(theta)).mean(axis=1), abs=1e-12
    )


def test_index_below_one_is_refused() -> None:
    with pytest.raises(ValueError, match="starts at 1"):
        zernike.noll_orders(0)
