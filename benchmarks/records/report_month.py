"""A simulated month: how long its report and its overview take, and how much memory.

2.6e7 ticks at 10 Hz and a figure every 4 s, written by the recorder's own tables in batches of a
minute (the Rerun segments, which neither command reads, are left out). Writing takes some minutes,
so the month is kept in a folder for as long as the benchmark runs only.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import Rows
from tests.support.figures import Figure, at_most
from tests.support.peak_memory import peak_mb
from tests.worlds.nights import RATE_HZ, night, planted, write_run

MONTH_DAYS = 30.0
# Written part by part: a part is this long, and only one is in memory.
_PART_HOURS = 6.0
_CHILD = """
import json, sys, time
from membrane_ctrl.cli import run
from tests.support.peak_memory import peak_mb
began = time.monotonic()
code = run(sys.argv[1:])
print(json.dumps({"code": code, "took_s": time.monotonic() - began, "peak_gb": peak_mb() / 1e3}))
"""


def parts(days: float, seed: int = 1) -> Iterator[tuple[Rows, list[ShapeEstimate]]]:
    """A run of so many days, part by part, each with events of its own."""
    rng = np.random.default_rng(seed)
    hours = 24.0 * days
    for number, start_h in enumerate(np.arange(0.0, hours, _PART_HOURS)):
        length_h = min(_PART_HOURS, hours - float(start_h))
        start_s = 3600.0 * float(start_h)
        events = planted(rng, length_h, share=0.1) if length_h >= 1 else []
        events = [type(e)(e.kind, e.time_s + start_s, e.size) for e in events]
        yield night(seed + number, length_h, "typical", events, start_s)


def timed(*arguments: str) -> dict[str, float]:
    """Wall time and peak memory of a command in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", _CHILD, *arguments], capture_output=True, text=True, check=True
    )
    found = dict(json.loads(done.stdout.splitlines()[-1]))
    if found.pop("code"):
        raise RuntimeError(f"{' '.join(arguments)}: {done.stderr.strip()}")
    return found


def run(days: float = MONTH_DAYS) -> list[Figure]:
    """Report and review of a month, and of half an hour."""
    with tempfile.TemporaryDirectory(prefix="membrane-month-") as folder:
        month, short = (
            Path(folder) / "20261121T180000Z-month",
            Path(folder) / "20261121T180000Z-short",
        )
        began_s = time.monotonic()
        write_run(month, parts(days))
        wrote_s = time.monotonic() - began_s
        write_run(short, parts(0.5 / 24))
        size_gb = sum(path.stat().st_size for path in month.rglob("*") if path.is_file()) / 1e9
        timed(
            "report", str(short), "--out", f"{folder}/warm"
        )  # imports from the disk, kernels from their cache
        brief = timed("report", str(short), "--out", f"{folder}/a")
        whole = timed("report", str(month), "--out", f"{folder}/b")
        opened = timed("review", str(month), "--save", f"{folder}/review.rrd")
        shown = timed("runs", "show", str(month))
        return [
            Figure("ticks", days * 86400 * RATE_HZ, ""),
            Figure("tables on the disk", size_gb, "GB"),
            Figure("time to write them (without Rerun)", wrote_s, "s"),
            at_most("report of the month", whole["took_s"], "s", 60.0),
            at_most("... memory", whole["peak_gb"], "GB", 2.0),
            at_most("report of half an hour", brief["took_s"], "s", 5.0),
            at_most("time to make the recording for the viewer", opened["took_s"], "s", 10.0),
            Figure("... memory", opened["peak_gb"], "GB"),
            Figure("`runs show` of the month", shown["took_s"], "s"),
        ]


if __name__ == "__main__":
    from tests.support.figures import show

    show("report_month", run(float(sys.argv[1]) if len(sys.argv) > 1 else MONTH_DAYS))
    print(f"own peak {peak_mb() / 1e3:.2f} GB")
