"""Predicted standard deviations of a loop, in a given disturbance.

The true centre is S d - T n for a disturbance d and laser noise n; its variance is the integral of
its spectrum. The pump's limits count as they do on average (`linearise_limits`).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.model.arrays import FloatArray
from tuning.identification import closed_loop, plant_model
from tuning.identification.disturbance import DisturbanceModel

# Of the swing and of what the limits leave of it, each from the other: within 1 % of the preview's.
_ROUNDS = 4
_UNLIMITED_SHARE = 1 - 1e-3  # the limits leave more than this: they do not matter
# Search for the mean of the unclipped flow: steps, and error relative to the mean.
_MEAN_STEPS = 20
_MEAN_ERROR = 1e-3
# The mean flow stays this share of the largest flow away from 0 and from the largest.
_LEAST_MEAN = 1e-3
_MOST_MEAN = 0.999
_LEAST_INSIDE = 1e-3  # share of time within the limits that a step of the search divides by


@dataclass(frozen=True, slots=True)
class Predicted:
    """Standard deviations: of the true centre, of the feedback's flow, and of its change from tick
    to tick.
    """

    std_um: float
    flow_std_um_per_s: float
    flow_step_std_um_per_s: float


def predict_loop(
    gains: closed_loop.Gains,
    model: plant_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
) -> Predicted:
    """Predict the standard deviations of a stable loop.

    Parameters
    ----------
    gains : Gains
        Of the loop.
    model : PlantModel
        The identified plant.
    disturbance : DisturbanceModel
        The identified weather and noise.
    loop : LoopConfig
        Feed-forward and limits of the flow, which count as they do on average
        (`linearise_limits`).

    Returns
    -------
    Predicted
    """
    dt_s = disturbance.rest.dt_s
    w = closed_loop.make_frequencies(dt_s)
    plant, moving = linearise_limits(gains, model, disturbance, loop, w)
    noise = disturbance.rest.white_psd

    # Spectra of the centre, S d - T n, of the feedback's flow, and of its change in a tick.
    sensitivity = 1 / (1 + closed_loop.compute_loop_response(gains, plant, w, dt_s))
    disturbed = np.abs(sensitivity) ** 2 * moving
    followed_noise = np.abs(1 - sensitivity) ** 2 * noise
    centre = disturbed + followed_noise
    controller = closed_loop.compute_controller_response(gains, w)
    flow = np.abs(controller * sensitivity) ** 2 * (moving + noise)
    change = flow * np.abs(2 * np.sin(w * dt_s / 2)) ** 2
    return Predicted(
        std_um=math.sqrt(_integrate_variance(centre, w)),
        flow_std_um_per_s=math.sqrt(_integrate_variance(flow, w)),
        flow_step_std_um_per_s=math.sqrt(_integrate_variance(change, w)),
    )


def _integrate_variance(psd: FloatArray, w: FloatArray) -> float:
    """Variance of a two-sided spectrum: its integral over w / pi, in steps of log w."""
    return float(np.trapezoid(psd * w, np.log(w))) / math.pi


def linearise_limits(
    gains: closed_loop.Gains,
    model: plant_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    w: FloatArray,
) -> tuple[plant_model.PlantModel, FloatArray]:
    """Linearise a plant whose pump has limits.

    The pump gives no less than nothing and no more than `loop.flow_max_um_per_s`. Of a flow that
    swings like a Gaussian, the limits leave a share, and add noise of their own, whose correlation
    is the square of the flow's.

    Parameters
    ----------
    gains, model, disturbance, loop
        As in `predict_loop`.
    w : (n,) array
        Angular frequencies, rad/s.

    Returns
    -------
    plant : PlantModel
        The plant as such a pump drives it.
    moving : (n,) array
        Spectrum of the centre without feedback, µm^2 s.

    Notes
    -----
    Statistical linearisation: Gelb and Vander Velde, Multiple-Input Describing Functions (1968),
    chapter 7.
    """
    dt_s = disturbance.rest.dt_s
    noise = disturbance.rest.white_psd
    controller = closed_loop.compute_controller_response(gains, w)
    forward = disturbance.feedforward_psd(w, loop)
    pump = closed_loop.compute_pump_response(model, w, dt_s)
    plant = model
    moving = disturbance.psd(w, model, loop)
    for _ in range(_ROUNDS):
        # The flow's variance in the present plant, and what the limits leave of its changes.
        sensitivity = 1 / (1 + closed_loop.compute_loop_response(gains, plant, w, dt_s))
        flow = np.abs(controller * sensitivity) ** 2 * (moving + noise) + forward
        variance = _integrate_variance(flow, w)
        std_um_per_s = math.sqrt(variance)
        mean_um_per_s = model.holding_flow_um_per_s
        share, rest = _clip_changes(std_um_per_s, mean_um_per_s, loop.flow_max_um_per_s)
        if share > _UNLIMITED_SHARE:
            break

        # The weaker pump, and the noise that clipping adds: of the variance `rest`, with the
        # correlation time of the squared flow.
        memory_s = _integrate_variance(flow**2, w) / variance**2
        plant = replace(model, gain=model.gain * share)
        added = rest * memory_s / (1 + (w * memory_s / 2) ** 2)
        moving = disturbance.psd(w, plant, loop) + added * np.abs(pump / w) ** 2
    return plant, moving


def _clip_changes(std: float, mean: float, most: float) -> tuple[float, float]:
    """Clip a Gaussian flow at 0 and `most`.

    Parameters
    ----------
    std : float
        Standard deviation of the unclipped flow, µm/s.
    mean : float
        Mean of the clipped flow. An integrator finds the unclipped one, as Newton's method does
        here.
    most : float
        Upper limit.

    Returns
    -------
    share : float
        Of small changes that passes: the probability to be within the limits.
    variance : float
        That clipping adds to what passes.
    """
    mean = min(max(mean, _LEAST_MEAN * most), _MOST_MEAN * most)
    before = mean
    for _ in range(_MEAN_STEPS):
        # The limits in standard deviations, and the density of the Gaussian there.
        low = -before / std
        high = (most - before) / std
        density_low = math.exp(-0.5 * low * low) / math.sqrt(2 * math.pi)
        density_high = math.exp(-0.5 * high * high) / math.sqrt(2 * math.pi)

        # Mean of the clipped flow: its part within the limits, and `most` above them.
        inside = ndtr(high) - ndtr(low)
        above = most * ndtr(-high)
        after = before * inside + std * (density_low - density_high) + above
        if abs(after - mean) < _MEAN_ERROR * mean:
            break
        before += (mean - after) / max(inside, _LEAST_INSIDE)

    # Mean square of the clipped flow; less the mean's and that of what passes.
    within = (before**2 + std**2) * inside
    at_limits = std * (before * density_low - (before + most) * density_high)
    square = within + at_limits + most * above
    variance = square - after**2 - (inside * std) ** 2
    return float(inside), float(max(0.0, variance))
