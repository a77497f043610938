"""Laboratories drawn at random, one after the other (`tests/studies/laboratory_sessions.py`).

`python -m benchmarks.tuning.laboratories --count 40` adds lines of JSON for each to
build/laboratories.jsonl; a second call continues where the first ended. `--part start` only
starts them, `--part defaults` holds them with the defaults, `--part sessions` tunes them.
`--rate-hz 10` examines those of this tick rate only, which take a fifth of the time of 50 Hz. It
writes the page docs/measurements/tuning-laboratories.md.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from tests.studies.laboratory_sessions import (
    PARTS,
    describe_outcome,
    examine,
    format_page,
    is_held,
)
from tests.worlds.drawn_laboratories import draw_laboratory

FILE = Path("build/laboratories.jsonl")
PAGE = Path("docs/measurements/tuning-laboratories.md")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """A row for each seed, in their order: the answers of all its parts in a file of lines."""
    if not path.exists():
        return []
    rows: dict[int, dict[str, Any]] = {}
    for line in path.read_text(encoding="utf-8").splitlines(keepends=True):
        if not line.endswith("\n"):
            continue
        answer = json.loads(line)
        row = rows.setdefault(int(answer["seed"]), {"parts": []})
        row["parts"].append(answer["part"])
        row.update(answer)
    return [rows[seed] for seed in sorted(rows)]


def main() -> None:
    """Examine what is missing in the file, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--file", type=Path, default=FILE)
    parser.add_argument("--part", choices=PARTS, action="append", help="default: all")
    parser.add_argument("--rate-hz", type=float, action="append", help="default: all")
    parser.add_argument("--page", type=Path, default=PAGE)
    given = parser.parse_args()
    given.file.parent.mkdir(parents=True, exist_ok=True)
    parts = given.part or PARTS
    known = {row["seed"]: row for row in read_rows(given.file)}
    for seed in range(given.first, given.first + given.count):
        if given.rate_hz and draw_laboratory(seed).rate_hz not in given.rate_hz:
            continue
        for part in parts:
            row = known.get(seed, {"parts": []})
            if part in row["parts"]:
                continue
            answer = examine(seed, part, row)
            with given.file.open("a", encoding="utf-8") as file:
                file.write(json.dumps(answer) + "\n")
            known[seed] = {**row, **answer, "parts": [*row["parts"], part]}
            outcomes = {
                "start": "start_s" in answer,
                "defaults": is_held(answer),
                "sessions": describe_outcome(answer),
            }
            print(seed, part, outcomes[part], f"{answer['cpu_s']:.0f} s", flush=True)
    given.page.write_text(format_page(read_rows(given.file)), encoding="utf-8")


if __name__ == "__main__":
    main()
