"""How often `report --compare` calls alike runs different, and how often it finds a known
difference.

`python -m benchmarks.records.comparison` prints the tables of docs/how-to/review.md. Series are 1 s
means with a standard deviation of 1 and an exponential autocorrelation; those with excursions step
away for 20 s, twice an hour on average, by up to six times that.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from membrane_ctrl.review.statistics.drift import mean_p, spread_p

LENGTHS_S = {"2 min": 120, "10 min": 600, "30 min": 1800, "3 h": 10_800}
MEMORIES_S = {"uncorrelated": 0.0, "3 s": 3.0, "30 s": 30.0, "300 s": 300.0}
RATIOS = (1.25, 1.5, 2.0, 3.0, 10.0)
EXCURSION_S, EXCURSIONS_PER_S = 20, 2 / 3600
LEVEL = 0.05


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


def main() -> None:
    """Print both tables."""
    print("| length | " + " | ".join(MEMORIES_S) + " | 3 s, with excursions |")
    print("|---" * (len(MEMORIES_S) + 2) + "|")
    for length, size in LENGTHS_S.items():
        found = [rates(size, memory_s, 1.0, 400) for memory_s in MEMORIES_S.values()]
        found.append(rates(size, 3.0, 1.0, 400, excursions=True))
        print(
            f"| {length} | "
            + " | ".join(f"{spread:.3f}, {mean:.3f}" for spread, mean in found)
            + " |"
        )
    print(
        "\n| length, correlation time | "
        + " | ".join(f"{ratio:g} times" for ratio in RATIOS)
        + " |"
    )
    print("|---" * (len(RATIOS) + 1) + "|")
    for length, size in LENGTHS_S.items():
        for name in ("3 s", "30 s", "300 s"):
            found = [rates(size, MEMORIES_S[name], ratio, 100) for ratio in RATIOS]
            print(
                f"| {length}, {name} | " + " | ".join(f"{spread:.2f}" for spread, _ in found) + " |"
            )


if __name__ == "__main__":
    main()
