"""Margins of the linear loop, with its dead times exact: the sampled loop as it runs, at every
frequency.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.control.filters import lag_step_fraction
from membrane_ctrl.control.loop_margins import DEAD_S, PUMP_LAG_S, open_loop, peak_sensitivity


@pytest.mark.parametrize("rate_hz", [20.0, 50.0, 100.0])
def test_default_tuning_is_robust(rate_hz: float) -> None:
    assert 1.0 < peak_sensitivity(LoopConfig(rate_hz=rate_hz)) <= 1.4


def excursion(loop: LoopConfig, last_s: float = 60.0) -> float:
    """Largest error in the last quarter after a kick of 1 µm, stepped in time: checks the frequency
    domain.
    """
    dt_s = 1 / loop.rate_hz
    fine = max(1, round(dt_s / 0.005))
    h_s = dt_s / fine
    late = [0.0] * round(DEAD_S / h_s)
    mirror, flow, filtered, before, integral = 1.0, 0.0, 1.0, 1.0, 0.0
    errors = []
    for _ in range(round(last_s / dt_s)):
        filtered += lag_step_fraction(dt_s, loop.measurement_filter_s) * (mirror - filtered)
        command = loop.kp_per_s * (-filtered + integral - loop.td_s * (filtered - before) / dt_s)
        integral -= filtered * dt_s / loop.ti_s
        before = filtered
        for _ in range(fine):
            late.append(command)
            flow += h_s / PUMP_LAG_S * (late.pop(0) - flow)
            mirror += h_s * flow
        errors.append(abs(mirror))
        if errors[-1] > 1e6:
            break
    return max(errors[-len(errors) // 4 :])


@pytest.mark.parametrize(
    ("change", "stable"),
    [
        ({}, True),
        ({"kp_per_s": 2.0}, True),
        ({"kp_per_s": 20.0}, False),
        ({"kp_per_s": 8.0}, False),
        ({"ti_s": 0.2}, False),
        ({"kp_per_s": 0.05, "ti_s": 100.0}, True),
        ({"measurement_filter_s": 10.0, "kp_per_s": 1.0, "ti_s": 3.0}, False),
        ({"td_s": 10.0}, False),
        ({"rate_hz": 1.0, "kp_per_s": 3.0, "measurement_filter_s": 0.0}, True),
        ({"rate_hz": 1.0, "kp_per_s": 6.0, "measurement_filter_s": 0.0}, False),
    ],
)
def test_margins_call_a_loop_unstable_exactly_if_it_diverges(
    change: dict[str, float], stable: bool
) -> None:
    loop = LoopConfig(**change)  # type: ignore[arg-type]
    assert math.isfinite(peak_sensitivity(loop)) == stable
    assert (excursion(loop) < 1.0) == stable


def test_a_loop_without_gain_has_no_sensitivity() -> None:
    assert math.isnan(peak_sensitivity(LoopConfig(kp_per_s=0.0)))


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
    import control

    loop = LoopConfig(rate_hz=200.0)
    s = control.tf("s")
    dead = control.tf(*control.pade(DEAD_S + 0.5 / loop.rate_hz, 4))
    pi = loop.kp_per_s * (1 + 1 / (loop.ti_s * s))
    continuous = pi / (1 + loop.measurement_filter_s * s) * dead / (1 + PUMP_LAG_S * s) / s
    omega = np.geomspace(0.05, 10, 50)
    exact = open_loop(loop, omega)
    assert np.max(np.abs(continuous(1j * omega) - exact) / np.abs(exact)) < 0.03
