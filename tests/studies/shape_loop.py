"""The shape loop on the simulated bench, in virtual time; shape estimates are truth plus noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config.schema import LoopConfig, PumpConfig, ShapeConfig, TwinConfig
from membrane_ctrl.control.inner_loop import InnerLoop, LoopInput
from membrane_ctrl.control.shape_loop import ShapeLoop, ShapeOutput
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import ShapeState
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sim.plant import Plant
from tests.studies.minimum_variance import WRITE_S

# Of a paraboloid with a little of the Hencky bowl's spherical terms (Noll 4, 11, 22); piston
# follows the vertex.
SENSITIVITY = np.zeros(ZERNIKE_TERMS)
SENSITIVITY[[0, 3, 10, 21]] = 0.5, 0.2887, -0.012, 0.001

EXPOSURES_S = 0.8  # 8 frames
LATENCY_S = 0.2  # last frame to estimate
ON_S = 20.0  # the inner loop has settled, the shape loop is switched on
LOOP = LoopConfig()
SHAPE = ShapeConfig(time_constant_s=60.0)


@dataclass(frozen=True, slots=True)
class Tracked:
    """A run, one row a tick (arrays of equal length), and the last output of the shape loop."""

    time_s: NDArray[np.float64]
    true_um: NDArray[np.float64]
    trim_um: NDArray[np.float64]
    bias_um: NDArray[np.float64]
    last: ShapeOutput


def estimate_of(
    time_s: float, sag_change_um: float, displacement_um: float, noise_um: NDArray[np.float64]
) -> ShapeEstimate:
    """A shape estimate of a mirror whose sag has changed; `noise_um` (terms,) is added to the
    coefficients.
    """
    return ShapeEstimate(
        time_s=time_s,
        kind="fringes",
        coeffs_um=SENSITIVITY * sag_change_um + noise_um,
        hencky_um=37_100.0,
        covariance_um2=1e-6 * np.eye(ZERNIKE_TERMS),
        sag_um=37_100.0 + sag_change_um,
        sag_change_sigma_um=0.01,
        displacement_um=displacement_um,
        slope_residual_urad=3.0,
        valid_fraction=0.99,
        modulation_median_adu=80.0,
        saturated_fraction=0.0,
        verdict="ok",
    )


class EstimateMaker:
    """Estimates as a cycle gives them: mean of the truth and of the laser over the exposures, then
    the latency.
    """

    def __init__(self, period_s: float, sag_noise_um: float, seed: int) -> None:
        self._period_s = period_s
        self._coefficient_noise_um = sag_noise_um * float(np.linalg.norm(SENSITIVITY[1:]))
        self._rng = np.random.default_rng(seed)
        self._seen: list[tuple[float, float]] = []
        self._begin_s = 0.0

    def tick(self, now_s: float, true_um: float, laser_um: float) -> ShapeEstimate | None:
        """One tick of the bench; an estimate when one is ready."""
        into_s = now_s - self._begin_s
        if into_s < EXPOSURES_S:
            self._seen.append((true_um, laser_um))
        if into_s < max(self._period_s, EXPOSURES_S + LATENCY_S) - 1e-6:
            return None
        sag_um, mean_laser_um = np.mean(self._seen, axis=0)
        middle_s = self._begin_s + EXPOSURES_S / 2
        self._seen, self._begin_s = [], now_s
        noise_um = self._coefficient_noise_um * self._rng.standard_normal(ZERNIKE_TERMS)
        return estimate_of(middle_s, float(sag_um), float(mean_laser_um), noise_um)


def track(
    twin: TwinConfig, duration_s: float, sag_noise_um: float = 0.2, shape: ShapeConfig = SHAPE
) -> Tracked:
    """Hold the mirror with both loops, for `duration_s` from when the shape loop is switched on, if
    enabled.
    """
    plant, inner = Plant(twin, PumpConfig()), InnerLoop(LOOP, PumpConfig())
    shape_loop, maker = (
        ShapeLoop(shape, SENSITIVITY),
        EstimateMaker(shape.period_s, sag_noise_um, twin.seed),
    )
    dt_s = 1 / LOOP.rate_hz
    inner.start(plant.sample().displacement_um, plant.truth().leak_um_per_s)
    out = ShapeOutput(ShapeState.OFF, "", 0.0, np.nan, np.nan, np.nan)
    rows = []
    for _ in range(round((ON_S + duration_s) * LOOP.rate_hz)):
        now_s, sample, truth = plant.time_s, plant.sample(), plant.truth()
        settled = now_s >= ON_S
        shape_loop.switch(shape.enabled and settled, now_s)
        estimate = maker.tick(now_s, truth.displacement_um, sample.displacement_um)
        out = shape_loop.step(now_s, dt_s, estimate, sample.displacement_um, settled)
        reading = sample.displacement_um, sample.ambient_pressure_pa, sample.air_temperature_c
        command = inner.step(LoopInput(0.0, out.trim_um, *reading), dt_s)
        rows.append((now_s, truth.displacement_um, out.trim_um, truth.laser_bias_um))
        plant.advance(WRITE_S)
        plant.actuate(command.pump_fraction, 0.0)
        plant.advance(dt_s - WRITE_S)
    return Tracked(*np.array(rows).T, last=out)
