"""The least standard deviation of the true centre that any linear controller could reach.

No controller can avoid the pump's dead time theta: a decision now acts at t + theta, so the
centre's error is at least the error of the best prediction of the disturbance over theta from the
readings until now (Astrom, Introduction to Stochastic Control Theory, 1970, chapter 6). The best
prediction is the Kalman filter's. The pump's lag is no limit of its own: it can be inverted.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from membrane_ctrl.config.schema import LoopConfig, TwinConfig
from membrane_ctrl.sim.surroundings import SCENARIOS

TRANSPORT_S = 0.075  # the pump's tube
WRITE_S = 0.005  # sample to write

Matrix = NDArray[np.float64]


def _discrete(drift: Matrix, diffusion: Matrix, step_s: float) -> tuple[Matrix, Matrix]:
    """Transition and noise covariance over a step (Van Loan 1978)."""
    n = len(drift)
    block = expm(np.block([[-drift, diffusion], [np.zeros((n, n)), drift.T]]) * step_s)
    transition = block[n:, n:].T
    return transition, transition @ block[:n, n:]


def least_std_um(
    loop: LoopConfig, twin: TwinConfig, laser: bool = True, optics_um_per_root_hz: float = math.inf
) -> float:
    """Bound in µm for the loop's rate and sensors in the twin's scenario.

    `optics_um_per_root_hz`: noise of the measured sag times the root of the interval of frames;
    they count as prompt.
    """
    (pressure_pa, pressure_s), (air_k, air_s) = SCENARIOS[twin.scenario]
    follow_s = loop.gas_follows_air_s
    # states: ambient pressure, air temperature, gas temperature
    drift = np.array(
        [[-1 / pressure_s, 0, 0], [0, -1 / air_s, 0], [0, 1 / follow_s, -1 / follow_s]]
    )
    diffusion = np.diag([2 * pressure_pa**2 / pressure_s, 2 * air_k**2 / air_s, 0.0])
    centre = np.array([loop.barometer_gain_um_per_pa, 0.0, loop.temperature_gain_um_per_k])
    readings: list[Matrix] = []
    noise: list[float] = []
    if laser:
        readings.append(centre)
        noise.append(twin.laser_noise_um**2 + twin.laser_resolution_um**2 / 12)
    if math.isfinite(optics_um_per_root_hz):
        readings.append(centre)
        noise.append(optics_um_per_root_hz**2 * loop.rate_hz)
    if loop.feedforward_barometer:
        readings.append(np.array([1.0, 0.0, 0.0]))
        noise.append(twin.barometer_noise_pa**2)
    if loop.feedforward_temperature:
        readings.append(np.array([0.0, 1.0, 0.0]))
        noise.append(twin.thermometer_noise_k**2)
    c, r = np.array(readings), np.diag(noise)
    transition, kicks = _discrete(drift, diffusion, 1 / loop.rate_hz)
    before = solve_discrete_are(transition.T, c.T, kicks, r)
    after = before - before @ c.T @ np.linalg.solve(c @ before @ c.T + r, c @ before)
    dead_s = TRANSPORT_S + WRITE_S + 0.5 / loop.rate_hz  # the command holds for a tick
    transition, kicks = _discrete(drift, diffusion, dead_s)
    return float(np.sqrt(centre @ (transition @ after @ transition.T + kicks) @ centre))
