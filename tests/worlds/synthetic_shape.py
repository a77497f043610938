"""Shape estimates of a bowl at rest, with numbers that use all bits of a double."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.run_files.shapes import NUMBERS, Shapes


def shape_at(time_s: float) -> ShapeEstimate:
    """The estimate of a cycle that ended just before `time_s`."""
    rng = np.random.default_rng(round(1000 * time_s))
    coeffs_um = np.zeros(ZERNIKE_TERMS)
    coeffs_um[[0, 3]] = 37_000 / 2, 37_000 / (2 * np.sqrt(3))
    coeffs_um[1:] += 0.02 * rng.normal(size=ZERNIKE_TERMS - 1)
    factor = rng.normal(size=(ZERNIKE_TERMS, ZERNIKE_TERMS)) * 1e-3
    return ShapeEstimate(
        time_s=time_s - 0.3 + 1e-3 * rng.random(),
        kind="fringes",
        coeffs_um=coeffs_um,
        hencky_um=rng.normal(),
        covariance_um2=factor @ factor.T + 1e-4 * np.eye(ZERNIKE_TERMS),
        sag_um=37_000.0 + 0.1 * rng.normal(),
        sag_change_sigma_um=0.1 * rng.random(),
        displacement_um=0.1 * rng.normal(),
        slope_residual_urad=3.1,
        valid_fraction=0.99,
        modulation_median_adu=81.0,
        saturated_fraction=0.0,
        verdict="ok",
        reason="as good as it gets: 100 %",
        latency_s=0.05 * rng.random(),
        cycle=round(time_s),
    )


def from_estimates(estimates: Sequence[ShapeEstimate]) -> Shapes:
    """Shapes of estimates in memory, all covariances among them."""
    numbers = {
        name: np.array([getattr(estimate, name) for estimate in estimates]) for name in NUMBERS
    }
    return Shapes(
        **numbers,
        coeffs_um=np.array([estimate.coeffs_um for estimate in estimates]).reshape(
            -1, ZERNIKE_TERMS
        ),
        verdict=np.array([estimate.verdict for estimate in estimates], dtype=np.str_),
        covariance_time_s=numbers["time_s"],
        covariance_um2=np.array([estimate.covariance_um2 for estimate in estimates]).reshape(
            -1, ZERNIKE_TERMS, ZERNIKE_TERMS
        ),
    )
