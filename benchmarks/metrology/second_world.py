"""Verdicts and error bars of `measure` on random benches of the second optical world.

`make benches` (`python -m benchmarks.metrology.second_world 500`) measures up to 500 benches (two
sets each) at a quarter of the resolution, on all cores, and writes
docs/measurements/second-world.md from all answers that there are. The answers go to a file for each
resolution, a line of JSON a bench: a stopped run continues where it was. `second_world 20 full`
measures at full size, `second_world 500 eighth` at an eighth; a second number is the first seed
(`second_world 200 500`: seeds 500 to 699). `second_world page` writes the page from the answers
that are there. Answers of a later program to some of its benches, in the file `quarter_again`,
have a section of their own.
"""

from __future__ import annotations

import json
import os
import sys
from functools import partial
from pathlib import Path
from typing import Any

from tests.studies.resumable_answers import answers
from tests.studies.second_benches import bench_answer
from tests.studies.second_world_tables import (
    PARTS,
    held,
    name_geometry,
    page,
    refusals,
    share_far,
)
from tests.support.figures import Figure, at_least, at_most

BENCHES = 500
RESOLUTIONS = {"quarter": 0.25, "eighth": 0.125, "full": 1.0}
PAGE = Path("docs/measurements/second-world.md")


def answers_file(resolution: str) -> Path:
    """File of the answers at a resolution."""
    return Path(f"logs/second_world_{resolution}.jsonl")


def measured_benches(count: int, resolution: str, first: int = 0) -> list[dict[str, Any]]:
    """Benches at a resolution, from a seed on; the missing ones are measured."""
    return answers(
        answers_file(resolution),
        count,
        partial(bench_answer, resolution=RESOLUTIONS[resolution]),
        workers=_count_workers(resolution),
        first=first,
    )


def _count_workers(resolution: str) -> int:
    """One at full size, whose benches need a gigabyte each; else one for each core."""
    if resolution == "full":
        return 1
    return os.cpu_count() or 1


def run(count: int = BENCHES, first: int = 0) -> list[Figure]:
    """Coverage by quantity, wrong `ok`s and true causes."""
    given = measured_benches(count, "quarter", first)
    figures = []
    for fine in (False, True):
        some = [one for one in given if one["fine"] == fine]
        for of in ("height", "change"):
            for quantity, part in PARTS.items():
                share, width, size = held(some, of, part)
                label = f"{name_geometry(fine)}, {of}: {quantity} in its 95 % interval ({size})"
                figures.append(
                    Figure(label, 100 * share, "%", "width over scatter", width, "93 .. 97")
                )
    far, numbers = share_far(given)
    label = f"numbers of `ok` sets beyond 3 sigma, of {numbers}"
    figures.append(at_most(label, 100 * far, "%", 0.5))
    refused = refusals(given)
    label = f"refusals whose stated cause is planted, of {len(refused)}"
    true = sum(is_right is True for is_right, _, _ in refused)
    figures.append(at_least(label, 100 * true / max(len(refused), 1), "%", 95))
    return figures


def read_answers(path: Path) -> list[dict[str, Any]]:
    """Whole lines of a file of answers, in the order of their seeds; empty without a file."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    given = [json.loads(line) for line in lines if line.endswith("\n")]
    return sorted(given, key=lambda one: int(one["seed"]))


def main(arguments: list[str]) -> None:
    """Measure the benches that are missing, print the figures, write the page."""
    numbers = [int(argument) for argument in arguments if argument.isdigit()]
    count = numbers[0] if numbers else BENCHES
    first = numbers[1] if len(numbers) > 1 else 0
    named = [argument for argument in arguments if argument in RESOLUTIONS]
    if named:
        measured_benches(count, named[0], first)
    elif "page" not in arguments:
        for figure in run(count, first):
            print(f"{figure.name}: {figure.value:.1f} {figure.unit} {figure.reference_value or ''}")
    given = {name: read_answers(answers_file(name)) for name in RESOLUTIONS}
    by_size = dict(sorted(given.items(), key=lambda item: -len(item[1])))
    again = read_answers(answers_file("quarter_again"))
    PAGE.write_text(page(by_size, again), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
