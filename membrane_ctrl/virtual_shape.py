"""Shapes made from the twin's truth: what a measurement cycle would say, without rendering a frame.

For runs of days in virtual time and for the fault campaign; the real cycle on rendered frames is `virtual_camera`.
"""

from __future__ import annotations

import numpy as np

from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.metrology.hencky import zernike_projection
from membrane_ctrl.virtual_bench import VirtualBench

SAG_SIGMA_UM = 1.0  # of one cycle (docs/physics.md, outer loop)


class TruthShape:
    """A `virtual_run.ShapeSource`; equal seeds give equal shapes.

    Parameters
    ----------
    bench : VirtualBench
        What is measured, and what is wrong with the camera.
    seed : int
        Of the noise.
    """

    def __init__(self, bench: VirtualBench, seed: int) -> None:
        self._bench = bench
        self._rng = np.random.default_rng(seed)
        self._projection = zernike_projection()
        self._covariance = SAG_SIGMA_UM**2 * np.outer(self._projection, self._projection)
        self._cycle = 0

    def __call__(self, now_s: float) -> ShapeEstimate | None:
        """One cycle; None while the camera is lost."""
        wrong = self._bench.wrong
        if wrong.camera_lost:
            return None
        self._cycle += 1
        truth = self._bench.plant.truth()
        noise_um = SAG_SIGMA_UM * float(self._rng.standard_normal())
        sag_um = 1e3 * truth.sag_mm + wrong.camera_offset_um + noise_um
        return ShapeEstimate(
            time_s=now_s,
            kind="fringes",
            coeffs_um=sag_um * self._projection,
            hencky_um=0.0,
            covariance_um2=self._covariance,
            sag_um=sag_um,
            sag_sigma_um=SAG_SIGMA_UM,
            displacement_um=truth.displacement_um + truth.laser_bias_um + wrong.laser_offset_um,
            slope_residual_urad=1.0,
            valid_fraction=1.0,
            modulation_median_adu=80.0,
            saturated_fraction=0.0,
            verdict="ok",
            cycle=self._cycle,
        )
