"""Days of a mirror held by the estimate of its centre, in virtual time, while its sensors change.

Each change of `tests/studies/centre_week.py` is judged separately: how far the mirror moved, and
which events were reported.

python -m benchmarks.control.centre_week [--days 1] [--seeds 3]
"""

from __future__ import annotations

import argparse

from tests.studies.centre_week import BUMP_UM, DAY_S, Day, days
from tests.support.figures import Figure, at_most, show


def figures(day: Day, count: float) -> list[Figure]:
    """Of a run."""
    bumps = [change.bump_um for change in day.changes]
    return [
        Figure("changes", len(day.changes), ""),
        at_most("faults", len(day.faults), "", 0),
        at_most("missed ticks", day.missed, "", 0),
        Figure("held", 100 * day.held_s / (count * DAY_S), "% of the time"),
        Figure("standard deviation of the true centre", day.std_um, "um"),
        Figure("the same in an hour, median", day.hour_um, "um"),
        at_most("largest bump of a change", max(bumps), "um", BUMP_UM),
        at_most("changes with a larger one", sum(bump > BUMP_UM for bump in bumps), "", 0),
        at_most(
            "changes that are not told once",
            sum(not change.told_once for change in day.changes),
            "",
            0,
        ),
        Figure("CPU time", day.cpu_s, "s"),
    ]


def main() -> None:
    """Print each seed's figures, and the changes that were not bumpless."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--days", type=float, default=1.0, help="of each seed")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=1)
    options = parser.parse_args()
    for seed in range(options.first, options.first + options.seeds):
        day = days(options.days, seed)
        show(f"seed {seed}", figures(day, options.days))
        for line in day.faults + day.notices:
            print(line)
        for change in day.changes:
            print(
                f"{change.at_s:.0f} s {change.kind} {'begins' if change.begins else 'ends'}: "
                f"{change.bump_um:.2f} µm; {' | '.join(change.held_by)} "
                f"{' '.join(change.faulty_sensors)}"
                f"{'' if change.told_once else ' NOT ONCE'}",
                flush=True,
            )


if __name__ == "__main__":
    main()
