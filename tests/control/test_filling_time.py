"""Times to lower and to fill a mirror, against steps of its equation."""

from __future__ import annotations

import math

import pytest

from membrane_ctrl.control.filling_time import find_fall_s, find_filling_s, find_leak_speed

SAG_MM, PRESSURE_PA = 37.0, 600.0


def test_the_leak_lowers_as_its_equation_in_steps() -> None:
    """dp/dt = -(p / T) (p / p0)^(2/3) with the time constant T."""
    time_constant_s, dt_s = 1.0e4, 1.0
    pressure_pa, time_s = PRESSURE_PA, 0.0
    while pressure_pa > 5.0:
        pressure_pa -= dt_s * pressure_pa / time_constant_s * (pressure_pa / PRESSURE_PA) ** (2 / 3)
        time_s += dt_s
    leak = find_leak_speed(SAG_MM, time_constant_s)
    assert find_fall_s(SAG_MM, PRESSURE_PA, 5.0, leak) == pytest.approx(time_s, rel=1e-3)


@pytest.mark.parametrize("leak_um_per_s", [0.0, 1.24, 4.9])
def test_the_pump_fills_as_its_equation_in_steps(leak_um_per_s: float) -> None:
    sag_um, time_s, dt_s = 0.0, 0.0, 0.5
    while sag_um < 1e3 * SAG_MM:
        sag_um += dt_s * (5.0 - leak_um_per_s * (sag_um / 1e3 / SAG_MM) ** 3)
        time_s += dt_s
    found_s = find_filling_s(SAG_MM, 5.0, leak_um_per_s)
    assert found_s == pytest.approx(time_s, rel=2e-3)


def test_what_never_ends_is_infinite() -> None:
    assert math.isinf(find_filling_s(SAG_MM, 1.0, 1.0))
    assert math.isinf(find_filling_s(SAG_MM, 0.0, 0.0))
    assert math.isinf(find_fall_s(SAG_MM, PRESSURE_PA, 5.0, 0.0))
