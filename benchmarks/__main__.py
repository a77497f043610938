"""Run benchmarks, print a table each, and put the figures with the machine's description into a
JSON file and a page.

Each benchmark's entry carries its own date and machine, so that a part can be measured again by
itself.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.figures import as_json, machine, show
from benchmarks.page import page

# those that need a quiet machine first, those that take long last
NAMES = (
    "hold_live",
    "ticks",
    "snapshots",
    "viewers",
    "live_cycle",
    "tracking",
    "measure_full",
    "monte_carlo",
    "acquisition",
    "tracking_live",
    "virtual_time",
    "held",
    "centre",
    "laser_drift",
    "report_month",
    "events_found",
    "links",
    "calibration",
    "calibration_time",
    "coverage",
    "calibration_coverage",
    "benches",
    "recording",
    "recording_tracked",
    "memory",
    "tracking_long",
    "soak",
)
OUT = Path("docs/measurements/bench.json")
PAGE = Path("docs/measurements/bench.md")


def main(names: list[str]) -> int:
    """Run the named benchmarks, all by default; 1 if a target was missed."""
    unknown = [name for name in names if name not in NAMES]
    if unknown:
        print(
            f"benchmarks: unknown {', '.join(unknown)}; known are {', '.join(NAMES)}",
            file=sys.stderr,
        )
        return 2
    if (
        len(names) != 1
    ):  # each in a process of its own: memory and compiled code of one are no figure of another
        command = [sys.executable, "-m", "benchmarks"]
        return max(
            subprocess.run([*command, name], check=False).returncode for name in names or NAMES
        )
    (name,) = names
    about = machine()
    Console(width=150).print(", ".join(f"{key} {value}" for key, value in about.items()))
    figures = importlib.import_module(f"benchmarks.{name}").run()
    show(name, figures)
    _record(
        name,
        {
            "date_utc": f"{datetime.now(UTC):%Y-%m-%d}",
            "machine": about,
            "figures": as_json(figures),
        },
    )
    print(f"written to {OUT} and {PAGE}")
    return int(any(figure.met is False for figure in figures))


def _record(name: str, entry: dict[str, Any]) -> None:
    report = json.loads(OUT.read_text(encoding="utf-8")) if OUT.exists() else {}
    report[name] = entry
    ordered = {known: report[known] for known in NAMES if known in report}
    OUT.write_text(json.dumps(ordered, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page(ordered), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
