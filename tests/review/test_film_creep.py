"""Creep of films that obey other laws than the fit's: chains of springs and dashpots."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.review.statistics.film_creep import fit_creep

DAY_S = 86_400.0


def chain(rng: np.random.Generator, time_s: np.ndarray) -> np.ndarray:
    """Log stiffness of a Prony series: springs and dashpots with retardation times over seven
    decades.
    """
    times_s = 10 ** np.arange(1.0, 8.5, 0.5)
    parts = rng.uniform(0.5, 1.5, times_s.size) * 10 ** rng.uniform(-3.5, -2.5)
    return -np.log1p(parts @ (1 - np.exp(-time_s / times_s[:, None])))


def test_the_interval_of_tomorrow_holds_the_truth() -> None:
    """Weeks of a film loaded an hour before, with noise that lasts for hours; 95 % intervals."""
    rng, z, significant = np.random.default_rng(5), [], 0
    for _ in range(16):
        days = rng.uniform(3, 30)
        time_s = 3600 + np.linspace(0, days * DAY_S, 80)
        noise = np.zeros(time_s.size)
        for k in range(1, noise.size):
            noise[k] = 0.6 * noise[k - 1] + rng.normal()
        noise *= 10 ** rng.uniform(-5.5, -4.0)
        both = chain(rng, np.append(time_s, time_s[-1] + DAY_S))
        creep = fit_creep(time_s, both[:-1] + noise, DAY_S)
        z.append((creep.drift - (both[-1] - both[-2])) / creep.drift_sigma)
        significant += creep.is_certain
    held = float(np.mean(np.abs(z) < 1.96))
    assert held > 0.8, (held, np.sqrt(np.mean(np.square(z))))
    assert significant > 8  # the bars are not merely wide


def test_no_creep_is_reported_for_a_film_that_does_not_creep() -> None:
    rng = np.random.default_rng(2)
    found = [
        fit_creep(np.linspace(0, 5 * DAY_S, 50), 1e-5 * rng.normal(size=50), DAY_S)
        for _ in range(10)
    ]
    assert sum(creep.is_certain for creep in found) <= 2


def test_too_few_readings_and_too_far_ahead_are_errors() -> None:
    with pytest.raises(ValueError, match="too few for a law of creep"):
        fit_creep(np.arange(3.0), np.zeros(3), 1.0)
    with pytest.raises(ValueError, match="do not predict 24 h ahead"):
        fit_creep(np.linspace(0, 3600.0, 50), np.zeros(50), DAY_S)
