"""Tuning on the simulated bench, in virtual time, seed by seed: identified, proposed and achieved
figures.

`run()` gives the figures, `python -m benchmarks.tuning.sessions` prints them as the tables of
docs/measurements/tuning.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import numpy as np

from tests.studies.tuning_sessions import PLANTS, SESSIONS, VERIFY_S, identified, session


def summary(rows: Iterable[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Mean, smallest, largest of each figure."""
    listed = list(rows)
    columns = {key: np.array([row[key] for row in listed]) for key in listed[0]}
    found = {
        k: {"mean": float(v.mean()), "min": float(v.min()), "max": float(v.max())}
        for k, v in columns.items()
    }
    for key in ("gain_z", "dead_time_z", "delay_z"):
        found[key]["within_2_sigma"] = float(np.mean(np.abs(columns[key]) <= 2))
    return found


def run(seeds: int = 16, judge_s: float = VERIFY_S) -> dict[str, Any]:
    """All figures over `seeds` twins a case."""
    chosen = range(1, seeds + 1)
    return {
        "cases": {name: asdict(case) for name, case in (SESSIONS | PLANTS).items()},
        "sessions": {
            name: summary(session(case, seed, name == "typical, 1 µm", judge_s) for seed in chosen)
            for name, case in SESSIONS.items()
        },
        "plants": {
            name: summary(identified(case, seed) for seed in chosen)
            for name, case in PLANTS.items()
        },
    }


def _print(figures: dict[str, Any]) -> None:
    print(
        "| bench | k error: mean, worst | 2 sigma | dead time error s: mean, worst | 2 sigma "
        "| delay error s: mean, worst | within 2 sigma (k, dead time, delay) | excursion µm, "
        "worst | minutes |\n|---" + "|---" * 8 + "|"
    )
    for name, case in (figures["sessions"] | figures["plants"]).items():
        k, dead, delay = case["gain_error"], case["dead_time_error_s"], case["delay_error_s"]
        cover = ", ".join(
            f"{case[key]['within_2_sigma']:.0%}" for key in ("gain_z", "dead_time_z", "delay_z")
        )
        print(
            f"| {name} | {k['mean']:+.1%}, {_worst(k):.1%} | {2 * case['gain_sigma']['mean']:.1%} "
            f"| {dead['mean']:+.3f}, {_worst(dead):.3f} | "
            f"{2 * case['dead_time_sigma_s']['mean']:.3f} "
            f"| {delay['mean']:+.3f}, {_worst(delay):.3f} | {cover} | "
            f"{case['excursion_um']['max']:.1f} "
            f"| {case['duration_s']['mean'] / 60:.1f} |"
        )
    print(
        "\n| bench | least µm | achieved µm | / least: mean, worst | predicted / achieved: "
        "min, max "
        "| bias µm, worst | K 1/s | Ti s | filter s | Ms |\n|---" + "|---" * 9 + "|"
    )
    for name, case in figures["sessions"].items():
        ratio, predicted = case["ours_ratio"], case["predicted_over_achieved"]
        print(
            f"| {name} | {case['least_um']['mean']:.3f} | {case['ours_um']['mean']:.3f} "
            f"| {ratio['mean']:.2f}, {ratio['max']:.2f} "
            f"| {predicted['min']:.2f}, {predicted['max']:.2f} "
            f"| {_worst(case['ours_bias_um']):.3f} | {case['kp_per_s']['mean']:.2f} | "
            f"{case['ti_s']['mean']:.1f} "
            f"| {case['filter_s']['mean']:.2f} | {case['ms']['mean']:.2f} |"
        )
    print(
        "\n| typical, 1 µm, laser only | std µm: mean, worst | / least | bias µm, worst "
        "|\n|---|---|---|---|"
    )
    case = figures["sessions"]["typical, 1 µm"]
    for key in ("ours", "default", "simc", "amigo", "zn"):
        std = case[f"{key}_um"]
        print(
            f"| {key} | {std['mean']:.3f}, {std['max']:.3f} | {case[f'{key}_ratio']['mean']:.2f} "
            f"| {_worst(case[f'{key}_bias_um']):.3f} |"
        )


def _worst(figure: dict[str, float]) -> float:
    return max(abs(figure["min"]), abs(figure["max"]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--judge-s", type=float, default=VERIFY_S)
    options = parser.parse_args()
    _print(run(options.seeds, options.judge_s))
