"""Margins of the linear loop, with its dead times exact: the sampled loop as it runs, at every frequency."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.config import LoopConfig
from membrane_ctrl.control.filters import smoothing

PUMP_LAG_S = 0.15
DEAD_S = 0.075 + 0.005  # transport; sample to write


def open_loop(loop: LoopConfig, omega: np.ndarray) -> np.ndarray:
    """L(i omega): PI and filter as difference equations, hold, dead time, pump lag, integrating mirror."""
    dt_s = 1 / loop.rate_hz
    z = np.exp(1j * omega * dt_s)
    share = smoothing(dt_s, loop.measurement_filter_s)
    measurement_filter = share / (1 - (1 - share) / z)
    derivative = loop.td_s * (1 - 1 / z) / dt_s
    pi = loop.kp_per_s * (1 + dt_s / loop.ti_s / (z - 1) + derivative)  # the integrator moves after the output
    hold = (1 - 1 / z) / (1j * omega * dt_s)
    mirror = np.exp(-1j * omega * DEAD_S) / (1 + 1j * omega * PUMP_LAG_S) / (1j * omega)
    return np.asarray(pi * measurement_filter * hold * mirror)


def peak_sensitivity(loop: LoopConfig) -> float:
    omega = np.geomspace(1e-3, np.pi * loop.rate_hz * 0.999, 20_000)
    return float(np.max(1 / np.abs(1 + open_loop(loop, omega))))


@pytest.mark.parametrize("rate_hz", [20.0, 50.0, 100.0])
def test_default_tuning_is_robust(rate_hz: float) -> None:
    assert peak_sensitivity(LoopConfig(rate_hz=rate_hz)) <= 1.4


def test_phase_and_gain_margin() -> None:
    omega = np.geomspace(1e-2, 50, 20_000)
    response = open_loop(LoopConfig(), omega)
    phase_deg = np.degrees(np.unwrap(np.angle(response)))
    phase_deg -= 360 * round((phase_deg[0] + 180) / 360)
    crossing = np.argmin(np.abs(np.abs(response) - 1))
    assert phase_deg[crossing] + 180 > 45
    reversal = np.argmin(np.abs(phase_deg + 180) + (omega < 1) * 1e3)
    assert 1 / np.abs(response[reversal]) > 4


def test_the_sampled_loop_agrees_with_python_control() -> None:
    """The same loop written down in continuous time, delays as a Pade approximation."""
    control = pytest.importorskip("control")
    loop = LoopConfig(rate_hz=200.0)
    s = control.tf("s")
    dead = control.tf(*control.pade(DEAD_S + 0.5 / loop.rate_hz, 4))
    pi = loop.kp_per_s * (1 + 1 / (loop.ti_s * s))
    continuous = pi / (1 + loop.measurement_filter_s * s) * dead / (1 + PUMP_LAG_S * s) / s
    omega = np.geomspace(0.05, 10, 50)
    exact = open_loop(loop, omega)
    assert np.max(np.abs(continuous(1j * omega) - exact) / np.abs(exact)) < 0.03
