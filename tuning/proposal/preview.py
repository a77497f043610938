"""Simulates a loop on the fitted twin before anything is applied."""

from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from tuning.identification import load_step, plant_model, record
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal.model_bench import ModelBench
from tuning.rigs.bench_rig import Rig

_SETTLE_S = 30.0


@dataclass(frozen=True, slots=True)
class Preview:
    """Result on the fitted twin."""

    std_um: float  # of the true centre
    bias_um: float  # target minus true centre
    # After a step of the leak, weather off: furthest excursion, and time until the centre stays
    # within `RECOVERED_UM`
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
    """Hold on the fitted twin in its weather, and once more without
    weather for a step of the leak.
    """
    loop = loop.model_copy(update={"rate_hz": 1.0 / disturbance.rest.dt_s})  # of fresh readings
    true_um = _simulate_hold(
        loop, pump, model, ModelBench(model, disturbance, pump, seed), duration_s
    )
    noise = replace(
        disturbance.rest, white=disturbance.rest.white * 1e-3, fast=0.0, slow=0.0, coloured=()
    )
    calm = DisturbanceModel(noise, None, None)
    stepped = ModelBench(model, calm, pump, seed, (_SETTLE_S, load_step_um_per_s))
    answer_um = _simulate_hold(loop, pump, model, stepped, 120.0)
    away = np.flatnonzero(np.abs(answer_um) > load_step.RECOVERED_UM)
    return Preview(
        std_um=float(true_um.std()),
        bias_um=-float(true_um.mean()),
        load_peak_um=float(np.abs(answer_um).max()),
        recovery_s=float((away[-1] + 1) / loop.rate_hz) if away.size else 0.0,
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
