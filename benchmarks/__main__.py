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

from benchmarks.figures_page import page
from tests.support.figures import as_json, machine, show

# Name and package. Those that need a quiet machine first, those that take long last.
BENCHMARKS = {
    "hold_live": "benchmarks.control",
    "ticks": "benchmarks.control",
    "snapshots": "benchmarks.control",
    "viewers": "benchmarks.interfaces",
    "strangers": "benchmarks.interfaces",
    "alarm_delay": "benchmarks.interfaces",
    "live_cycle": "benchmarks.metrology",
    "tracking": "benchmarks.metrology",
    "measure_full": "benchmarks.metrology",
    "measure_command": "benchmarks.metrology",
    "monte_carlo": "benchmarks.metrology",
    "acquisition": "benchmarks.metrology",
    "tracking_live": "benchmarks.metrology",
    "virtual_time": "benchmarks.control",
    "held": "benchmarks.control",
    "climate_day": "benchmarks.control",
    "centre": "benchmarks.control",
    "laser_drift": "benchmarks.control",
    "report_month": "benchmarks.records",
    "events_found": "benchmarks.records",
    "links": "benchmarks.interfaces",
    "calibration": "benchmarks.metrology",
    "calibration_time": "benchmarks.metrology",
    "coverage": "benchmarks.metrology",
    "calibration_coverage": "benchmarks.metrology",
    "benches": "benchmarks.tuning",
    "recording": "benchmarks.records",
    "recording_tracked": "benchmarks.records",
    "mirror_years": "benchmarks.records",
    "memory": "benchmarks.records",
    "tracking_long": "benchmarks.metrology",
    "soak": "benchmarks.control",
}
OUT = Path("docs/measurements/bench.json")
PAGE = Path("docs/measurements/bench.md")


def main(names: list[str]) -> int:
    """Run the named benchmarks, all by default; 1 if a target was missed."""
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown:
        print(
            f"benchmarks: unknown {', '.join(unknown)}; known are {', '.join(BENCHMARKS)}",
            file=sys.stderr,
        )
        return 2
    if (
        len(names) != 1
    ):  # each in a process of its own: memory and compiled code of one are no figure of another
        command = [sys.executable, "-m", "benchmarks"]
        return max(
            subprocess.run([*command, name], check=False).returncode for name in names or BENCHMARKS
        )
    (name,) = names
    about = machine()
    Console(width=150).print(", ".join(f"{key} {value}" for key, value in about.items()))
    figures = importlib.import_module(f"{BENCHMARKS[name]}.{name}").run()
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
    ordered = {known: report[known] for known in BENCHMARKS if known in report}
    OUT.write_text(json.dumps(ordered, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page(ordered), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
