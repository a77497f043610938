"""Margins of the linear inner loop, from the frequency response of the sampled loop. Pure.

The response is that of the difference equations as they run, with exact dead times, at every
frequency up to the sampling limit.
"""

import math

import numpy as np

from membrane_ctrl.config.control import LoopConfig
from membrane_ctrl.control.filters import lag_step_fraction
from membrane_ctrl.model.arrays import ComplexArray, FloatArray

# docs/explanation/physics.md, inner loop; the tick itself takes 5 ms from sample to write
PUMP_LAG_S = 0.15
DEAD_S = 0.075 + 0.005
# Below the corner frequencies of the controller by this factor, L is a double integrator
_FAR_BELOW = 0.01
_POINTS = 2000
_ALIASES = 3  # they fall with the third power of the frequency


def open_loop(loop: LoopConfig, omega: FloatArray) -> ComplexArray:
    """Return L of the sampled loop: PID and filter as difference equations, hold, dead time, pump
    lag, mirror.

    Parameters
    ----------
    loop : LoopConfig
        Gains, filter and tick rate.
    omega : (n,) array
        Angular frequencies in rad/s, below the sampling limit.

    Returns
    -------
    (n,) complex array
        Without unit: the measured centre over the error, around the loop.
    """
    dt_s = 1 / loop.rate_hz
    z = np.exp(1j * omega * dt_s)
    # Measurement filter: y[n] = y[n - 1] + fraction (x[n] - y[n - 1])
    fraction = lag_step_fraction(dt_s, loop.measurement_filter_s)
    measurement_filter = fraction / (1 - (1 - fraction) / z)
    # PID; the integrator moves after the output, so that its sum is one tick late
    integral = dt_s / loop.ti_s / (z - 1)
    derivative = loop.td_s * (1 - 1 / z) / dt_s
    pid = loop.kp_per_s * (1 + integral + derivative)
    # Zero-order hold, dead time, pump lag and the mirror's integrator, summed over the aliases that
    # sampling folds back; at a tick rate of 1 Hz the aliases decide
    plant = np.zeros_like(z)
    for k in range(-_ALIASES, _ALIASES + 1):
        s = 1j * (omega + 2 * math.pi * k / dt_s)
        zero_order_hold = (1 - 1 / z) / (s * dt_s)
        pump = np.exp(-s * DEAD_S) / (1 + s * PUMP_LAG_S)
        plant += zero_order_hold * pump / s
    return np.asarray(pid * measurement_filter * plant)


def peak_sensitivity(loop: LoopConfig) -> float:
    """Return the largest amplification of a disturbance at any frequency; infinity for an unstable
    loop.

    The defaults stay below 1.4. NaN for a loop with `kp_per_s` 0.
    """
    if loop.kp_per_s == 0.0:
        return math.nan
    low = _FAR_BELOW * min(loop.kp_per_s, 1 / loop.ti_s)
    omega = np.geomspace(low, math.pi * loop.rate_hz * 0.999, _POINTS)
    return_difference = 1 + open_loop(loop, omega)
    # Nyquist: L has two poles at the origin and none outside, so 1 + L must turn by half a turn
    # from far below to the sampling limit; each further encirclement of -1 is a pair of unstable
    # poles.
    angle = np.unwrap(np.angle(return_difference))
    turned = float(angle[-1] - angle[0])
    if abs(turned - math.pi) > math.pi / 2:
        return math.inf
    return float(np.max(1 / np.abs(return_difference)))
