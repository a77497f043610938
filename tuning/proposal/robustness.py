"""A proposal on the plants that the data permit, drawn from the covariance of the fit."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import LoopConfig
from tuning.identification import closed_loop, margins, plant_fit, plant_model
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal import prediction

_QUANTILE = 0.95
# Least values of a drawn plant: share of the fitted gain, and lag.
_LEAST_GAIN_SHARE = 0.05
_LEAST_LAG_S = 1e-3


@dataclass(frozen=True, slots=True)
class Robustness:
    """Over the sampled plants: 95 % quantiles of sensitivity and standard deviation, and share of
    stable loops.
    """

    ms_p95: float
    std_p95_um: float
    stable_fraction: float


def sample_plants(
    identified: plant_fit.Identified, count: int, seed: int = 1
) -> list[plant_model.PlantModel]:
    """Draw plants from the fit's covariance.

    Parameters
    ----------
    identified : Identified
        The fit.
    count, seed : int
        Number of plants, and seed of the draws.

    Returns
    -------
    list of PlantModel
        Times and gain stay positive.
    """
    model = identified.model
    centre = np.array([model.gain, model.dead_time_s, model.lag_s, model.leak_um_per_s])
    draws = np.random.default_rng(seed).multivariate_normal(centre, identified.covariance, count)
    floor = np.array([_LEAST_GAIN_SHARE * model.gain, 0.0, _LEAST_LAG_S, 0.0])
    return [plant_model.PlantModel(*row) for row in np.maximum(draws, floor).tolist()]


def evaluate_robustness(
    gains: closed_loop.Gains,
    identified: plant_fit.Identified,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    count: int = 60,
) -> Robustness:
    """Evaluate gains on sampled plants; an unstable one counts as infinitely bad.

    Parameters
    ----------
    gains : Gains
        Judged on each plant.
    identified : Identified
        The fit, whose covariance the plants are drawn from.
    disturbance : DisturbanceModel
        Noise of the readings, and weather.
    loop : LoopConfig
        Its feed-forward and its limits.
    count : int
        Number of plants.
    """
    plants = sample_plants(identified, count)
    dt_s = disturbance.rest.dt_s
    peaks = np.array([margins.find_sensitivity_peak(gains, plant, dt_s) for plant in plants])
    stable = np.isfinite(peaks)
    stds_um = []
    for plant, is_stable in zip(plants, stable, strict=True):
        std_um = np.inf
        if is_stable:
            std_um = prediction.predict_loop(gains, plant, disturbance, loop).std_um
        stds_um.append(std_um)

    # The next value above: interpolating between a number and infinity is impossible.
    peak_p95 = float(np.quantile(peaks, _QUANTILE, method="higher"))
    std_p95_um = float(np.quantile(np.array(stds_um), _QUANTILE, method="higher"))
    return Robustness(peak_p95, std_p95_um, float(stable.mean()))
