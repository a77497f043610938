"""The loop's response to a step of the leak."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tuning.identification.closed_loop import SLOWEST_RAD_PER_S, Gains, compute_loop_response
from tuning.identification.plant_model import PlantModel
from tuning.identification.record import Series

# a load step is over when the centre stays this near, the limit for a mean of 60 s
RECOVERED_UM = 0.5
# 655 s, of which the first half is used: the transform takes the answer as periodic
_LOOK_S = 0.04
_LOOKS = 2**14


@dataclass(frozen=True, slots=True)
class LoadStep:
    """After a step of the leak: furthest excursion, and time until the centre stays within
    `RECOVERED_UM`.
    """

    peak_um: float
    recovery_s: float  # infinite if longer than five minutes


def simulate_load_step(
    gains: Gains, model: PlantModel, step_um_per_s: float, dt_s: float
) -> LoadStep:
    """The exact answer of a stable loop with its delay: D / s^2 / (1 + L),
    transformed into time.
    """
    w: Series = np.asarray(2 * np.pi * np.fft.rfftfreq(_LOOKS, _LOOK_S), dtype=float)
    w[0] = SLOWEST_RAD_PER_S  # L has two integrators: the answer is finite there
    answer = -step_um_per_s / w**2 / (1 + compute_loop_response(gains, model, w, dt_s))
    away_um = np.abs(np.fft.irfft(answer, _LOOKS)[: _LOOKS // 2]) / _LOOK_S
    away = np.flatnonzero(away_um > RECOVERED_UM)
    over_s = (int(away[-1]) + 1) * _LOOK_S if away.size else 0.0
    return LoadStep(float(away_um.max()), over_s if over_s < _LOOKS // 2 * _LOOK_S else math.inf)
