"""Simulates a loop on the fitted twin before anything is applied."""

from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from tuning.identification import load_step, plant_model, record
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal.model_bench import ModelBench
from tuning.rigs.bench_rig import Rig

_SETTLE_S = 30.0
_ANSWER_S = 120.0  # of the hold after a step of the leak
_QUIET_SHARE = 1e-3  # of the laser's noise, without weather


@dataclass(frozen=True, slots=True)
class Preview:
    """Result on the fitted twin.

    Attributes
    ----------
    std_um : float
        Standard deviation of the true centre.
    bias_um : float
        Target minus true centre.
    load_peak_um, recovery_s : float
        After a step of the leak, without weather: furthest excursion, and time until the centre
        stays within `RECOVERED_UM`.
    """

    std_um: float
    bias_um: float
    load_peak_um: float
    recovery_s: float


def preview_loop(
    loop: LoopConfig,
    pump: PumpConfig,
    model: plant_model.PlantModel,
    disturbance: DisturbanceModel,
    seed: int = 1,
    duration_s: float = 180.0,
    load_step_um_per_s: float = 0.6,
) -> Preview:
    """Hold on the fitted twin in its weather, and once more without weather for a step of the leak.

    Parameters
    ----------
    loop : LoopConfig
        The gains to preview.
    pump : PumpConfig
        The pump's curve.
    model : PlantModel
        The fitted plant.
    disturbance : DisturbanceModel
        Noise of the readings, and weather.
    seed : int
        Of both.
    duration_s : float
        Of the hold in its weather.
    load_step_um_per_s : float
        Step of the leak.

    Returns
    -------
    Preview
    """
    # In its weather, at the rate of fresh readings.
    loop = loop.model_copy(update={"rate_hz": 1.0 / disturbance.rest.dt_s})
    windy = ModelBench(model, disturbance, pump, seed)
    true_um = _simulate_hold(loop, pump, model, windy, duration_s)

    # Without weather and with hardly any noise, for a step of the leak.
    white = disturbance.rest.white * _QUIET_SHARE
    noise = replace(disturbance.rest, white=white, fast=0.0, slow=0.0, coloured=())
    calm = DisturbanceModel(noise, None, None)
    stepped = ModelBench(model, calm, pump, seed, (_SETTLE_S, load_step_um_per_s))
    answer_um = _simulate_hold(loop, pump, model, stepped, _ANSWER_S)
    away = np.flatnonzero(np.abs(answer_um) > load_step.RECOVERED_UM)
    recovery_s = 0.0
    if away.size:
        recovery_s = float((away[-1] + 1) / loop.rate_hz)
    return Preview(
        std_um=float(true_um.std()),
        bias_um=-float(true_um.mean()),
        load_peak_um=float(np.abs(answer_um).max()),
        recovery_s=recovery_s,
    )


def _simulate_hold(
    loop: LoopConfig,
    pump: PumpConfig,
    model: plant_model.PlantModel,
    bench: ModelBench,
    duration_s: float,
) -> record.Series:
    """True centre after settling."""
    rig = Rig(bench, loop, pump, model.holding_flow_um_per_s)
    rig.hold(_SETTLE_S + duration_s)
    return np.array(bench.true_um)[round(_SETTLE_S * loop.rate_hz) :]
