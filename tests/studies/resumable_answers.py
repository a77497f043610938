"""Answers of many benches in a file of JSON lines, to which a later call adds the missing ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from membrane_ctrl.processes.worker_pool import run_jobs


def answers(
    path: Path,
    count: int,
    bench: Callable[[int], dict[str, Any]],
    workers: int = 1,
    first: int = 0,
) -> list[dict[str, Any]]:
    """Answers of `count` seeds: those already in the file, and the missing ones, which are added to
    it.

    Parameters
    ----------
    path : Path
        The file.
    count : int
        Number of seeds.
    bench : function
        The answer of a seed. With several workers it must be picklable.
    workers : int
        Processes among which the missing seeds are divided.
    first : int
        The first seed.
    """
    path.parent.mkdir(exist_ok=True)
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
    whole = [line for line in lines if line.endswith("\n")]
    if len(whole) < len(lines):  # a run that was killed may leave half a line
        path.write_text("".join(whole), encoding="utf-8")
    known = {one["seed"]: one for one in map(json.loads, whole)}
    missing = [seed for seed in range(first, first + count) if seed not in known]
    with run_jobs(bench, missing, min(workers, len(missing))) as results:
        for seed, one in zip(missing, results, strict=True):
            known[seed] = one
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(one) + "\n")
    return [known[seed] for seed in range(first, first + count)]
