"""Shapes from the twin's truth: the results of measurement cycles, without rendering frames.

For runs of days in virtual time and for the fault campaign; the real cycle runs on rendered frames (`optics.camera`).
"""

import math
from collections.abc import Callable

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.metrology.optics.hencky import zernike_projection
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.sim.virtual_bench import VirtualBench

ShapeSource = Callable[[float], ShapeEstimate | None]
# Change of sag of a cycle of rendered full-size frames at 50 Hz in typical weather: 0.007 um (docs/control.md).
SAG_SIGMA_UM = 0.01
EXPOSURES_S = 0.9  # first to last frame of that cycle, over which the laser's readings are averaged


class TruthShape:
    """A `ShapeSource`; equal seeds give equal shapes.

    `sag_sigma_um` is the standard deviation of a cycle's sag, larger for a bench whose frames are worse than
    rendered ones.
    """

    def __init__(self, bench: VirtualBench, config: Config, seed: int, sag_sigma_um: float = SAG_SIGMA_UM) -> None:
        self._bench = bench
        self._rng = np.random.default_rng(seed)
        self._projection = zernike_projection()
        self._sag_sigma_um = sag_sigma_um
        self._laser_sigma_um = config.twin.laser_noise_um / math.sqrt(max(1.0, EXPOSURES_S * config.loop.rate_hz))
        self._covariance = sag_sigma_um**2 * np.outer(self._projection, self._projection)
        self._cycle = 0

    def __call__(self, now_s: float) -> ShapeEstimate | None:
        """One cycle; None while the camera is lost."""
        wrong = self._bench.wrong
        if wrong.camera_lost:
            return None
        self._cycle += 1
        truth = self._bench.plant.truth()
        sag_noise, laser_noise = self._rng.standard_normal(2).tolist()
        sag_um = 1e3 * truth.sag_mm + wrong.camera_offset_um + self._sag_sigma_um * sag_noise
        laser_um = truth.displacement_um + truth.laser_bias_um + wrong.laser_offset_um
        blind = wrong.no_light or truth.laser_lost > 0
        return ShapeEstimate(
            time_s=now_s,
            kind="fringes",
            coeffs_um=sag_um * self._projection,
            hencky_um=0.0,
            covariance_um2=self._covariance,
            sag_um=sag_um,
            sag_sigma_um=self._sag_sigma_um,
            displacement_um=math.nan if blind else laser_um + self._laser_sigma_um * laser_noise,
            slope_residual_urad=1.0,
            valid_fraction=1.0,
            modulation_median_adu=80.0,
            saturated_fraction=0.0,
            verdict="ok",
            cycle=self._cycle,
        )
