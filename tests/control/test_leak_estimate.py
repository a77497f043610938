"""Leak from flow and movement."""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.control.leak_estimate import FIRST_S, JUDGE_S, LeakEstimate

DT_S = 0.02


def run(
    estimate: LeakEstimate, leak: float, seconds: float, flow: float = 1.0, weather: float = 0.0
) -> None:
    """A mirror that moves by the balance of flow, leak and weather (µm/s), read with the laser's
    filtered noise.
    """
    estimate.skip_step()  # the centre of each run starts at 0
    rng, centre_um = np.random.default_rng(3), 0.0
    for _ in range(round(seconds / DT_S)):
        centre_um += (flow - leak + weather) * DT_S
        seen_um = centre_um + 0.2 * rng.standard_normal()
        estimate.update(flow + weather, seen_um, seen_um, DT_S)


@pytest.mark.parametrize(("flow", "weather"), [(1.24, 0.0), (0.0, 0.0), (3.0, 0.2)])
def test_leak_is_estimated_at_any_pump_flow(flow: float, weather: float) -> None:
    estimate = LeakEstimate()
    run(estimate, 1.24, 60.0, flow, weather)
    assert estimate.leak_um_per_s == pytest.approx(1.24, abs=0.02)


def test_there_is_no_leak_estimate_at_the_start() -> None:
    estimate = LeakEstimate()
    run(estimate, 1.24, FIRST_S - 1.0)
    assert math.isnan(estimate.leak_um_per_s)


def test_change_is_followed_within_minutes() -> None:
    estimate = LeakEstimate()
    run(estimate, 1.24, 120.0)
    run(estimate, 2.48, 180.0)
    assert estimate.leak_um_per_s == pytest.approx(2.48, abs=0.1)


def test_too_tight_is_judged_late_and_with_hysteresis() -> None:
    estimate = LeakEstimate()
    run(estimate, 0.2, JUDGE_S - 1.0)
    assert not estimate.too_tight
    run(estimate, 0.2, 60.0)
    assert estimate.too_tight
    run(estimate, 0.42, 600.0)
    assert estimate.too_tight
    run(estimate, 0.6, 600.0)
    assert not estimate.too_tight


def test_a_gap_in_the_readings_is_left_out() -> None:
    """Motion of the centre during the gap is no rate."""
    estimate = LeakEstimate()
    run(estimate, 1.0, 60.0)
    estimate.skip_step()
    estimate.update(1.0, 500.0, 500.0, DT_S)
    assert estimate.leak_um_per_s == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("by_um", [40.0, -40.0])
def test_a_jump_of_the_reading_is_not_counted_as_leak(by_um: float) -> None:
    """Within 0.1 s, behind the reading's filter; the leak is the flow."""
    estimate, measured, rng = LeakEstimate(), LowPass(), np.random.default_rng(5)
    for k in range(round(90.0 / DT_S)):
        read_um = by_um * min(max((k * DT_S - 60.0) / 0.1, 0.0), 1.0) + rng.standard_normal()
        estimate.update(1.24, read_um, measured.update(read_um, DT_S, 0.2), DT_S)
    assert estimate.leak_um_per_s == pytest.approx(1.24, abs=0.1)
