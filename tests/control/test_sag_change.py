"""Projection of a change of shape on sag."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.control.shape_loop import MODEL_FLOOR_UM, sag_change

S = np.zeros(36)
S[[0, 3, 10, 21]] = 0.5, 0.2887, -0.012, 0.001
COVARIANCE = 1e-6 * np.eye(36)


@pytest.mark.parametrize("sag_um", [-300.0, -0.1, 0.0, 2.0])
def test_pure_change_of_sag_is_found(sag_um: float) -> None:
    reference = np.arange(36.0)
    assert sag_change(reference + S * sag_um, reference, COVARIANCE, S).change_um == pytest.approx(sag_um)


def test_piston_and_other_shapes_are_not_sag() -> None:
    other = np.zeros(36)
    other[[0, 4, 5, 6, 7]] = 100.0, 3.0, -2.0, 5.0, 1.0
    assert sag_change(other, np.zeros(36), COVARIANCE, S).change_um == pytest.approx(0.0, abs=1e-12)


def test_sigma_is_the_scatter() -> None:
    rng, noise_um = np.random.default_rng(1), 0.1
    covariance = (noise_um**2 - MODEL_FLOOR_UM**2) * np.eye(36)
    found = [sag_change(noise_um * rng.standard_normal(36), np.zeros(36), covariance, S) for _ in range(2000)]
    assert np.std([f.change_um for f in found]) == pytest.approx(found[0].sigma_um, rel=0.05)


def test_uncertain_term_is_weighted_down() -> None:
    covariance = COVARIANCE.copy()
    covariance[3, 3] = 1e4
    off = np.zeros(36)
    off[3] = 1.0
    assert abs(sag_change(off, np.zeros(36), covariance, S).change_um) < 0.1


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e6])
def test_singular_covariance_is_no_trouble(scale: float) -> None:
    direction = np.ones(36)
    found = sag_change(S * 2.0, np.zeros(36), scale * np.outer(direction, direction), S)
    assert found.change_um == pytest.approx(2.0)
    assert 0.0 < found.sigma_um < np.inf
