"""How often `report --compare` calls equivalent runs different, and how often it finds a known
difference.

`python -m benchmarks.records.comparison` prints the tables of docs/measurements/review.md. Series
are 1 s means with a standard deviation of 1 and an exponential autocorrelation; those with
excursions step away for 20 s, twice an hour on average, by up to six times that.
"""

from __future__ import annotations

from tests.studies.comparison_rates import rates

LENGTHS_S = {"2 min": 120, "10 min": 600, "30 min": 1800, "3 h": 10_800}
MEMORIES_S = {"uncorrelated": 0.0, "3 s": 3.0, "30 s": 30.0, "300 s": 300.0}
RATIOS = (1.25, 1.5, 2.0, 3.0, 10.0)


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
