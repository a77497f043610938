"""The inner loop on the simulated bench, as the tables of docs/measurements/control.md.

python -m benchmarks.control.inner_loop [--seeds 4]
"""

from __future__ import annotations

import argparse
from typing import Any

from tests.studies.inner_loop import SENSORS, run


def _print(figures: dict[str, Any]) -> None:
    head = (
        "| {} | std µm | worst | least possible | bias µm | worst | 1 s means in band |"
        + "\n|---"
        + "|---" * 6
        + "|"
    )
    row = (
        "| {} | {std_um:.3f} | {worst_std_um:.3f} | {least_std_um:.3f} "
        "| {bias_um:+.3f} | {worst_bias_um:.3f} | {in_band_1s_fraction:.1%} |"
    )
    print(head.format("weather, sensors"))
    for scenario, cases in figures["steady"].items():
        for sensors, case in cases.items():
            print(row.format(f"{scenario}, {sensors}", **case))
    print("\n" + head.format("leak µm/s (warned)"))
    for leak, case in figures["tight"].items():
        print(row.format(f"{leak} ({case['too_tight_fraction']:.0%})", **case))
    print("\n| event | " + " | ".join(SENSORS) + " |\n|---" + "|---" * len(SENSORS) + "|")
    for event in ("leak doubled", "door +20 Pa", "door -20 Pa", "10 s without a reading"):
        cells = (
            ", ".join(f"{k} {v:.2f}" for k, v in case.items()) for case in figures[event].values()
        )
        print(f"| {event} | " + " | ".join(cells) + " |")
    print("\nstart from -25 µm: " + ", ".join(f"{k} {v:.2f}" for k, v in figures["start"].items()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--duration", type=float, default=300.0, help="seconds of each steady run")
    arguments = parser.parse_args()
    _print(run(arguments.seeds, arguments.duration))
