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

# of the swing and what the limits leave of it, each from the other: within 1 % of the preview's
_ROUNDS = 4


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
    """Of a stable loop; the pump's limits count as they do on average (`limited`)."""
    dt_s = disturbance.rest.dt_s
    w = closed_loop.make_frequencies(dt_s)
    model, moving = linearise_limits(gains, model, disturbance, loop, w)
    sensitivity, noise = (
        1 / (1 + closed_loop.compute_loop_response(gains, model, w, dt_s)),
        disturbance.rest.white_psd,
    )
    centre = np.abs(sensitivity) ** 2 * moving + np.abs(1 - sensitivity) ** 2 * noise
    flow = np.abs(closed_loop.compute_controller_response(gains, w) * sensitivity) ** 2 * (
        moving + noise
    )
    change = flow * np.abs(2 * np.sin(w * dt_s / 2)) ** 2
    return Predicted(
        *(math.sqrt(_integrate_variance(spectrum, w)) for spectrum in (centre, flow, change))
    )


def _integrate_variance(psd: FloatArray, w: FloatArray) -> float:
    return float(np.trapezoid(psd * w, np.log(w))) / math.pi


def linearise_limits(
    gains: closed_loop.Gains,
    model: plant_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    w: FloatArray,
) -> tuple[plant_model.PlantModel, FloatArray]:
    """The plant as a pump with limits drives it, and the spectrum of the centre without feedback at
    `w`, µm^2 s.

    The pump gives no less than nothing and no more than `loop.flow_max_um_per_s`. Statistical
    linearisation (Gelb and Vander Velde, Multiple-Input Describing Functions, 1968, chapter 7): of
    a flow that swings like a Gaussian, the limits leave a share, and add noise of their own, whose
    correlation is the square of the flow's.
    """
    dt_s, noise = disturbance.rest.dt_s, disturbance.rest.white_psd
    controller, forward = (
        closed_loop.compute_controller_response(gains, w),
        disturbance.feedforward_psd(w, loop),
    )
    plant, moving = model, disturbance.psd(w, model, loop)
    for _ in range(_ROUNDS):
        sensitivity = 1 / (1 + closed_loop.compute_loop_response(gains, plant, w, dt_s))
        flow = np.abs(controller * sensitivity) ** 2 * (moving + noise) + forward
        variance = _integrate_variance(flow, w)
        share, rest = _clip_changes(
            math.sqrt(variance), model.holding_flow_um_per_s, loop.flow_max_um_per_s
        )
        if share > 1 - 1e-3:
            break
        memory_s = _integrate_variance(flow**2, w) / variance**2
        plant = replace(model, gain=model.gain * share)
        added = rest * memory_s / (1 + (w * memory_s / 2) ** 2)
        moving = (
            disturbance.psd(w, plant, loop)
            + added * np.abs(closed_loop.compute_pump_response(model, w, dt_s) / w) ** 2
        )
    return plant, moving


def _clip_changes(std: float, mean: float, most: float) -> tuple[float, float]:
    """What limits of 0 and `most` leave of a Gaussian's small changes, and the variance that they
    add.

    `mean` is that of the clipped flow; an integrator finds the unclipped one, as Newton's method
    does here.
    """
    before = mean = min(max(mean, 1e-3 * most), 0.999 * most)
    for _ in range(20):
        low, high = -before / std, (most - before) / std
        inside, above = ndtr(high) - ndtr(low), most * ndtr(-high)
        density = [math.exp(-0.5 * at * at) / math.sqrt(2 * math.pi) for at in (low, high)]
        after = before * inside + std * (density[0] - density[1]) + above
        if abs(after - mean) < 1e-3 * mean:
            break
        before += (mean - after) / max(inside, 1e-3)
    square = (
        (before**2 + std**2) * inside
        + std * (before * density[0] - (before + most) * density[1])
        + most * above
    )
    return float(inside), float(max(0.0, square - after**2 - (inside * std) ** 2))
