"""Projection of a change of shape on sag."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.control.sag_change import MODEL_FLOOR_UM, compute_sag_change
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

S = np.zeros(ZERNIKE_TERMS)
S[[0, 3, 10]] = 0.5, 0.2887, -0.012
COVARIANCE = 1e-6 * np.eye(ZERNIKE_TERMS)


@pytest.mark.parametrize("sag_um", [-300.0, -0.1, 0.0, 2.0])
def test_pure_change_of_sag_is_found(sag_um: float) -> None:
    reference = np.arange(float(ZERNIKE_TERMS))
    assert compute_sag_change(
        reference + S * sag_um, reference, COVARIANCE, S
    ).change_um == pytest.approx(sag_um)


def test_piston_and_other_shapes_give_no_change_of_sag() -> None:
    other = np.zeros(ZERNIKE_TERMS)
    other[[0, 4, 5, 6, 7]] = 100.0, 3.0, -2.0, 5.0, 1.0
    assert compute_sag_change(
        other, np.zeros(ZERNIKE_TERMS), COVARIANCE, S
    ).change_um == pytest.approx(0.0, abs=1e-12)


def test_sigma_is_the_scatter() -> None:
    rng, noise_um = np.random.default_rng(1), 0.1
    covariance = (noise_um**2 - MODEL_FLOOR_UM**2) * np.eye(ZERNIKE_TERMS)
    found = [
        compute_sag_change(
            noise_um * rng.standard_normal(ZERNIKE_TERMS), np.zeros(ZERNIKE_TERMS), covariance, S
        )
        for _ in range(2000)
    ]
    assert np.std([f.change_um for f in found]) == pytest.approx(found[0].sigma_um, rel=0.05)


def test_uncertain_term_is_weighted_down() -> None:
    covariance = COVARIANCE.copy()
    covariance[3, 3] = 1e4
    off = np.zeros(ZERNIKE_TERMS)
    off[3] = 1.0
    assert abs(compute_sag_change(off, np.zeros(ZERNIKE_TERMS), covariance, S).change_um) < 0.1


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e6])
def test_a_singular_covariance_is_accepted(scale: float) -> None:
    direction = np.ones(ZERNIKE_TERMS)
    found = compute_sag_change(
        S * 2.0, np.zeros(ZERNIKE_TERMS), scale * np.outer(direction, direction), S
    )
    assert found.change_um == pytest.approx(2.0)
    assert 0.0 < found.sigma_um < np.inf
