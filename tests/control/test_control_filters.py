"""First-order filters at unequal steps."""

from __future__ import annotations

import math

import pytest

from membrane_ctrl.control.filters import LagRate, LowPass, lag_step_fraction

LAG_S = 0.2


def test_smoothing_composes_over_steps() -> None:
    """Two steps equal one step of their sum."""
    assert (1 - lag_step_fraction(0.3, 2.0)) * (1 - lag_step_fraction(0.5, 2.0)) == pytest.approx(
        1 - lag_step_fraction(0.8, 2.0)
    )


def test_no_lag_passes_through() -> None:
    assert LowPass().update(3.0, 0.02, 0.0) == 3.0


def test_low_pass_starts_at_its_first_input() -> None:
    low_pass = LowPass()
    assert low_pass.update(5.0, 0.02, 1.0) == 5.0
    assert low_pass.update(6.0, 1.0, 1.0) == pytest.approx(6.0 - math.exp(-1.0))


@pytest.mark.parametrize("lag_s", [0.0, 0.2, 12.0])
def test_rate_of_a_ramp(lag_s: float) -> None:
    rate = LagRate()
    for k in range(6000):
        rate.update(2.0 * k * 0.02, 0.02, lag_s)
    assert rate.rate_per_s == pytest.approx(2.0, rel=1e-3)


def test_rate_integrates_to_the_step() -> None:
    """A feed-forward made of it moves the centre by exactly the disturbance."""
    rate = LagRate()
    rate.update(0.0, 0.02, LAG_S)
    assert sum(rate.update(20.0, 0.02, LAG_S) * 0.02 for _ in range(500)) == pytest.approx(20.0)


def test_first_value_is_no_rate() -> None:
    assert LagRate().update(101_325.0, 0.02, LAG_S) == 0.0


def test_a_lost_input_decays_and_its_return_causes_no_step() -> None:
    rate = LagRate()
    for k in range(100):
        rate.update(0.02 * k, 0.02, LAG_S)
    before = rate.rate_per_s
    gone = [rate.update(math.nan, 0.02, LAG_S) for _ in range(20)]
    assert gone[0] < before
    assert gone == sorted(gone, reverse=True)
    assert 0 < gone[-1] < 0.2 * before
    assert rate.update(500.0, 0.02, LAG_S) == pytest.approx(gone[-1])


def test_an_input_that_was_never_valid_gives_no_rate() -> None:
    assert LagRate().update(math.nan, 0.02, LAG_S) == 0.0
