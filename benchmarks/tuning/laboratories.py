"""Laboratories drawn at random, one after the other (`tests/studies/laboratory_sessions.py`).

`python -m benchmarks.tuning.laboratories --count 40` adds one line of JSON for each to
build/laboratories.jsonl; a second call continues where the first ended. It writes the page
docs/measurements/tuning-laboratories.md.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from tests.studies.laboratory_sessions import describe_outcome, examine, format_page

FILE = Path("build/laboratories.jsonl")
PAGE = Path("docs/measurements/tuning-laboratories.md")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Whole lines of a file of answers, in the order of the seeds."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    rows = [json.loads(line) for line in lines if line.endswith("\n")]
    return sorted(rows, key=lambda row: int(row["seed"]))


def main() -> None:
    """Examine what is missing in the file, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--file", type=Path, default=FILE)
    parser.add_argument("--sessions-only", action="store_true")
    parser.add_argument("--page", type=Path, default=PAGE)
    given = parser.parse_args()
    given.file.parent.mkdir(parents=True, exist_ok=True)
    known = {row["seed"] for row in read_rows(given.file)}
    for seed in range(given.first, given.first + given.count):
        if seed in known:
            continue
        row = examine(seed, judged=not given.sessions_only)
        with given.file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        print(seed, describe_outcome(row), f"{row['cpu_s']:.0f} s", flush=True)
    given.page.write_text(format_page(read_rows(given.file)), encoding="utf-8")


if __name__ == "__main__":
    main()
