"""PI(D): terms, limits, wind-up, bumpless changes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from membrane_ctrl.control.pid import Pid, PidGains

V_MAX = 5.3
errors = st.floats(-1e4, 1e4)
steps = st.floats(1e-3, 1.0)
gains = st.builds(PidGains, st.floats(0, 20), st.floats(0.1, 3600), st.floats(0, 10))


@given(gains, st.lists(st.tuples(errors, errors, steps), max_size=50))
def test_integrator_stays_in_the_pumps_range(
    given_gains: PidGains, run: list[tuple[float, float, float]]
) -> None:
    pid = Pid(given_gains, V_MAX)
    for error_um, rate_um_per_s, dt_s in run:
        assert math.isfinite(pid.terms(error_um, rate_um_per_s).sum_um_per_s)
        pid.integrate(dt_s)
        assert 0.0 <= pid.integral_um_per_s <= V_MAX


@given(gains, gains, st.floats(0, V_MAX), st.floats(-0.1, 0.1))
def test_gain_change_is_bumpless(
    before: PidGains, after: PidGains, mean: float, error_um: float
) -> None:
    pid = Pid(before, V_MAX)
    pid.place(mean)
    wanted = pid.terms(error_um, 0.0).sum_um_per_s
    pid.set_gains(after)
    now = pid.terms(error_um, 0.0)
    if 0.0 < now.i_um_per_s < V_MAX:  # else the integrator's range does not allow it
        assert now.sum_um_per_s == pytest.approx(wanted, abs=1e-9)


def test_integral_action_has_its_time_constant() -> None:
    """After Ti the integral of a steady error has repeated the proportional term."""
    pid = Pid(PidGains(0.5, 4.0, 0.7), V_MAX)
    pid.place(1.0)
    for _ in range(200):
        pid.terms(1.0, 0.0)
        pid.integrate(0.02)
    assert pid.integral_um_per_s - 1.0 == pytest.approx(0.5)


def test_derivative_brakes_a_rising_measurement() -> None:
    assert Pid(PidGains(2.0, 4.0, 0.5), V_MAX).terms(0.0, 3.0).d_um_per_s == pytest.approx(-3.0)


@pytest.mark.parametrize("error_um", [100.0, -100.0])
def test_the_integrator_does_not_wind_up(error_um: float) -> None:
    """An hour at the limit is forgotten as fast as ten seconds: the sum leaves the limit when the
    error does.
    """
    pid = Pid(PidGains(0.61, 6.5, 0.0), V_MAX)
    pid.place(1.24)
    for _ in range(3600):
        pid.terms(error_um, 0.0)
        pid.integrate(1.0)
    wanted = pid.terms(-math.copysign(10.0, error_um), 0.0).sum_um_per_s
    assert wanted < 0.0 if error_um > 0 else wanted > V_MAX


def test_back_calculation_settles_at_the_limit() -> None:
    """Pushed up for ever, P + I exceeds the limit by K e: there back-calculation and integral
    action balance.
    """
    pid = Pid(PidGains(0.61, 6.5, 0.0), V_MAX)
    for _ in range(10_000):
        pid.terms(2.0, 0.0)
        pid.integrate(0.02)
    assert pid.integral_um_per_s == pytest.approx(V_MAX)


@pytest.mark.parametrize(("error_um", "limit_um_per_s"), [(10.0, V_MAX), (-10.0, 0.0)])
def test_back_calculation_goes_to_the_limit_with_the_integral_time(
    error_um: float, limit_um_per_s: float
) -> None:
    """Beyond the range dI/dt = (limit - I) / Ti, however large the error: v - u takes away K e."""
    pid = Pid(PidGains(0.61, 6.5, 0.0), V_MAX)
    pid.place(2.0)
    pid.terms(error_um, 0.0)
    pid.integrate(0.02)
    assert pid.integral_um_per_s == pytest.approx(2.0 + (limit_um_per_s - 2.0) * 0.02 / 6.5)


def test_a_preset_output_is_the_whole_output_until_the_next_error() -> None:
    """An earlier error, of another state, must not return with a change of gains."""
    pid = Pid(PidGains(0.5, 4.0, 0.5), V_MAX)
    pid.terms(3.0, 1.0)
    pid.place(1.0)
    pid.set_gains(PidGains(1.5, 4.0, 0.0))
    assert pid.integral_um_per_s == 1.0
