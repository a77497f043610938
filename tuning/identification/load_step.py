"""The loop's response to a step of the leak."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tuning.identification.closed_loop import SLOWEST_RAD_PER_S, Gains, compute_loop_response
from tuning.identification.plant_model import PlantModel
from tuning.identification.record import Series

# A load step is over when the centre stays this near, the limit for a mean of 60 s.
RECOVERED_UM = 0.5
# Samples of the answer: 655 s, of which the first half is used, as the transform takes the answer
# as periodic.
_SAMPLE_S = 0.04
_SAMPLES = 2**14


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
    """Simulate the exact answer of a stable loop with its delay.

    Parameters
    ----------
    gains : Gains
        Of a stable loop.
    model : PlantModel
        The plant.
    step_um_per_s : float
        Step D of the leak.
    dt_s : float
        Sample time of the loop.

    Returns
    -------
    LoadStep
        From D / s^2 / (1 + L), transformed into time.
    """
    # The spectrum of the answer. L has two integrators: the answer is finite at the lowest
    # frequency.
    frequencies_hz = np.fft.rfftfreq(_SAMPLES, _SAMPLE_S)
    w: Series = np.asarray(2 * np.pi * frequencies_hz, dtype=float)
    w[0] = SLOWEST_RAD_PER_S
    loop = compute_loop_response(gains, model, w, dt_s)
    spectrum = -step_um_per_s / w**2 / (1 + loop)

    # In time, and from when on it stays near.
    used = _SAMPLES // 2
    answer = np.fft.irfft(spectrum, _SAMPLES)[:used]
    away_um = np.abs(answer) / _SAMPLE_S  # the transform of samples is that of time over their step
    is_away = np.flatnonzero(away_um > RECOVERED_UM)
    recovery_s = 0.0
    if is_away.size:
        recovery_s = (int(is_away[-1]) + 1) * _SAMPLE_S
    if recovery_s >= used * _SAMPLE_S:
        recovery_s = math.inf
    return LoadStep(float(away_um.max()), recovery_s)
