"""A figure of a healthy default mirror, for tests that change one thing about it."""

from __future__ import annotations

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

SOUND_FIGURE = ShapeEstimate(
    time_s=10.0,
    kind="fringes",
    coeffs_um=np.zeros(ZERNIKE_TERMS),
    hencky_um=0.0,
    covariance_um2=np.eye(ZERNIKE_TERMS),
    sag_um=1e3 * Config().optics.mirror.sag_mm,
    sag_change_sigma_um=1.0,
    displacement_um=0.0,
    slope_residual_urad=10.0,
    valid_fraction=1.0,
    modulation_median_adu=80.0,
    saturated_fraction=0.0,
    verdict="ok",
)
