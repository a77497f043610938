"""Fading-memory tracker: no lag, known noise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.control.drift_tracker import DriftTracker

MEMORY_S, STEP_S = 60.0, 2.0


def test_steady_drift_is_followed_without_error() -> None:
    tracker = DriftTracker()
    tracker.begin(0.0)
    worst = 0.0
    for k in range(1, 400):
        time_s = k * STEP_S
        worst = max(worst, abs(tracker.drift_at(time_s, MEMORY_S) - time_s / 30))
        tracker.add_reading(time_s / 30, time_s, MEMORY_S)
    assert worst <= 1.05 * MEMORY_S / 30 / math.e
    assert tracker.drift_at(800.0, MEMORY_S) == pytest.approx(800.0 / 30, abs=1e-3)


def test_late_onset_is_behind_by_rate_times_memory_over_e() -> None:
    tracker = DriftTracker()
    tracker.begin(0.0)
    behind = []
    for k in range(1, 1000):
        time_s = k * STEP_S
        drift_um = max(0.0, time_s - 1000.0) / 30
        tracker.add_reading(drift_um, time_s, MEMORY_S)
        behind.append(drift_um - tracker.drift_at(time_s, MEMORY_S))
    assert max(behind) == pytest.approx(MEMORY_S / 30 / math.e, rel=0.05)
    assert behind[-1] == pytest.approx(0.0, abs=1e-3)


def test_output_noise_matches_the_derivation() -> None:
    rng, tracker, seen = np.random.default_rng(5), DriftTracker(), []
    tracker.begin(0.0)
    for k in range(1, 20_000):
        tracker.add_reading(float(rng.standard_normal()), k * STEP_S, MEMORY_S)
        seen.append(tracker.drift_at(k * STEP_S, MEMORY_S))
    assert np.std(seen[200:]) == pytest.approx(math.sqrt(1.25 * STEP_S / MEMORY_S), rel=0.1)


def test_first_readings_are_damped() -> None:
    rng, first = np.random.default_rng(6), []
    for _ in range(300):
        tracker = DriftTracker()
        tracker.begin(0.0)
        for k in range(1, 10):
            tracker.add_reading(float(rng.standard_normal()), k * STEP_S, MEMORY_S)
        first.append(tracker.drift_at(9 * STEP_S, MEMORY_S))
    assert np.std(first) < 0.5


def test_after_a_long_gap_the_first_reading_is_used() -> None:
    tracker = DriftTracker()
    tracker.begin(0.0)
    tracker.add_reading(0.0, 2.0, MEMORY_S)
    tracker.add_reading(5.0, 2000.0, MEMORY_S)
    assert tracker.drift_at(2000.0, MEMORY_S) == pytest.approx(5.0)
    assert tracker.drift_at(2010.0, MEMORY_S) == pytest.approx(5.0, abs=0.05)


def test_the_rate_is_extrapolated_for_one_memory_time() -> None:
    """A bump taken for a drift must not run away while there are no readings."""
    tracker = DriftTracker()
    tracker.begin(0.0)
    for k in range(1, 400):
        tracker.add_reading(k * STEP_S / 30, k * STEP_S, MEMORY_S)
    assert tracker.drift_at(5000.0, MEMORY_S) == tracker.drift_at(798.0 + MEMORY_S, MEMORY_S)
