"""How often a comparison of runs finds a difference, in simulated series with and without one."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from membrane_ctrl.review.statistics.difference_tests import mean_p, spread_p

LEVEL = 0.05
EXCURSION_S, EXCURSIONS_PER_S = 20, 2 / 3600


def series(
    rng: np.random.Generator, size: int, memory_s: float, std: float = 1.0, excursions: bool = False
) -> NDArray[np.float64]:
    """(2, size): seconds and values."""
    keep = math.exp(-1 / memory_s) if memory_s else 0.0
    before = round(10 * memory_s)
    values = signal.lfilter([math.sqrt(1 - keep**2)], [1.0, -keep], rng.normal(size=size + before))[
        before:
    ]
    for first in rng.integers(0, size, rng.poisson(EXCURSIONS_PER_S * size) if excursions else 0):
        values[first : first + EXCURSION_S] += rng.uniform(-6.0, 6.0)
    return np.stack((np.arange(size) + 0.5, std * values))


def rates(
    size: int, memory_s: float, ratio: float, trials: int, excursions: bool = False, seed: int = 1
) -> tuple[float, float]:
    """Share of pairs whose spreads, and whose means, are called different at `LEVEL`; they differ
    by `ratio`.
    """
    rng = np.random.default_rng(seed)
    pairs = [
        [series(rng, size, memory_s, std, excursions) for std in (1.0, ratio)]
        for _ in range(trials)
    ]
    spreads, means = ([test(a, b) < LEVEL for a, b in pairs] for test in (spread_p, mean_p))
    return float(np.mean(spreads)), float(np.mean(means))
