"""Predicted figures of a loop, and their scatter over plants."""

import math
from collections.abc import Sequence
from dataclasses import astuple

import numpy as np

from membrane_ctrl.config.schema import LoopConfig
from tuning.identification import closed_loop, load_step, loop_figures, margins, plant_model
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal import prediction


def compute_loop_figures(
    gains: closed_loop.Gains,
    model: plant_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    step_um_per_s: float,
) -> loop_figures.LoopFigures:
    """Compute the figures of a loop on one plant.

    Parameters
    ----------
    gains : Gains
        Of the loop.
    model : PlantModel
        The plant, perhaps drawn from the fit.
    disturbance : DisturbanceModel
        Noise of the readings, and weather.
    loop : LoopConfig
        Its feed-forward and its limits.
    step_um_per_s : float
        Step of the leak.

    Returns
    -------
    LoopFigures
        Infinite for an unstable loop.
    """
    dt_s = disturbance.rest.dt_s
    ms = margins.find_sensitivity_peak(gains, model, dt_s)
    if not math.isfinite(ms):
        return loop_figures.LoopFigures(math.inf, math.inf, math.inf, math.inf)
    answer = load_step.simulate_load_step(gains, model, step_um_per_s, dt_s)
    return loop_figures.LoopFigures(
        prediction.predict_loop(gains, model, disturbance, loop).std_um,
        answer.peak_um,
        answer.recovery_s,
        ms,
    )


def compute_half_widths(found: Sequence[loop_figures.LoopFigures]) -> loop_figures.LoopFigures:
    """Half of the central 68 % of each figure over many plants: 1 sigma; infinite if some of them
    are unstable.
    """
    rows = np.array([astuple(figures) for figures in found])
    low, high = np.quantile(rows, (0.16, 0.84), axis=0, method="nearest")
    with np.errstate(invalid="ignore"):  # infinite at both ends
        widths = np.where(np.isinf(high), np.inf, (high - low) / 2)
    return loop_figures.LoopFigures(*widths.tolist())
