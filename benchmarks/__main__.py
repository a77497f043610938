"""Run benchmarks, print a table each, and write all figures with the machine's description as JSON."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

from rich.console import Console

from benchmarks.figures import Figure, as_json, machine, show

# in the order of how much the figure depends on a quiet machine
NAMES = ("hold_live", "live_cycle", "measure_full", "held", "laser_drift", "links", "virtual_time", "soak")
OUT = Path("docs/bench.json")


def main(names: list[str]) -> int:
    """Run the named benchmarks, all by default; 1 if a target was missed."""
    unknown = [name for name in names if name not in NAMES]
    if unknown:
        print(f"benchmarks: unknown {', '.join(unknown)}; known are {', '.join(NAMES)}", file=sys.stderr)
        return 2
    about = machine()
    Console(width=150).print(", ".join(f"{key} {value}" for key, value in about.items()))
    results: dict[str, list[Figure]] = {}
    for name in names or NAMES:
        results[name] = importlib.import_module(f"benchmarks.{name}").run()
        show(name, results[name])
    if not names:  # a part is no record of the whole
        report = {"machine": about, "benchmarks": {name: as_json(figures) for name, figures in results.items()}}
        OUT.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        print(f"written to {OUT}")
    return int(any(f.met is False for figures in results.values() for f in figures))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
