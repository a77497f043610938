"""What a proposal does on the plants that the data allow: draws from the covariance of the fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config import LoopConfig
from tuning.disturbance_model import Disturbance
from tuning.identify import Identified
from tuning.loop_model import Gains
from tuning.margins import sensitivity_peak
from tuning.minimum_variance import predict
from tuning.plant_model import PlantModel


@dataclass(frozen=True, slots=True)
class Robustness:
    """Over the sampled plants: 95 % quantiles of sensitivity and standard deviation, and share of stable loops."""

    ms_p95: float
    std_p95_um: float
    stable_fraction: float


def sampled_plants(identified: Identified, count: int, seed: int = 1) -> list[PlantModel]:
    """Plants drawn from the fit's covariance; times and gain stay positive."""
    model = identified.model
    centre = np.array([model.gain, model.dead_time_s, model.lag_s, model.leak_um_per_s])
    draws = np.random.default_rng(seed).multivariate_normal(centre, identified.covariance, count)
    floor = np.array([0.05 * model.gain, 0.0, 1e-3, 0.0])
    return [PlantModel(*row) for row in np.maximum(draws, floor).tolist()]


def robustness(
    gains: Gains, identified: Identified, disturbance: Disturbance, loop: LoopConfig, count: int = 60
) -> Robustness:
    """Evaluate gains on sampled plants; an unstable one counts as infinitely bad."""
    plants = sampled_plants(identified, count)
    dt_s = disturbance.rest.dt_s
    peaks = np.array([sensitivity_peak(gains, plant, dt_s) for plant in plants])
    stable = np.isfinite(peaks)
    stds = np.array(
        [predict(gains, p, disturbance, loop).std_um if ok else np.inf for p, ok in zip(plants, stable, strict=True)]
    )
    # the next value above: a quantile between a number and infinity would be neither
    peak_p95, std_p95 = (float(np.quantile(values, 0.95, method="higher")) for values in (peaks, stds))
    return Robustness(peak_p95, std_p95, float(stable.mean()))
