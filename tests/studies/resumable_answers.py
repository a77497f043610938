"""Answers of many benches in a file of JSON lines, to which a later call adds the missing ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any


def answers(path: Path, count: int, bench: Callable[[int], dict[str, Any]]) -> list[dict[str, Any]]:
    """Those already in the file, and the missing ones, which are added to it."""
    path.parent.mkdir(exist_ok=True)
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
    whole = [line for line in lines if line.endswith("\n")]
    if len(whole) < len(lines):  # a run that was killed may leave half a line
        path.write_text("".join(whole), encoding="utf-8")
    known = {one["seed"]: one for one in map(json.loads, whole)}
    for seed in range(count):
        if seed not in known:
            known[seed] = bench(seed)
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(known[seed]) + "\n")
    return [known[seed] for seed in range(count)]
