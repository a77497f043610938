"""Known events of simulated nights that the review finds."""

from __future__ import annotations

import sys

from tests.studies.events_found import matched, search
from tests.support.figures import Figure, at_least, at_most


def run(nights: int = 100) -> list[Figure]:
    """Share found by kind, false alarms a night; two nights in three are typical,
    the others quiet.
    """
    total: dict[str, int] = {}
    lost: dict[str, int] = {}
    alarms = 0
    for seed in range(nights):
        events, found = search(seed, "quiet" if seed % 3 == 2 else "typical")
        missed, false = matched(events, found)
        alarms += len(false)
        for event in events:
            total[event.kind] = total.get(event.kind, 0) + 1
        for event in missed:
            lost[event.kind] = lost.get(event.kind, 0) + 1
    figures = [
        at_least(f"{kind}: found", 1 - lost.get(kind, 0) / count, f"of {count}", 0.95)
        for kind, count in sorted(total.items())
    ]
    return [*figures, at_most("false alarms", alarms / nights, "a night", 1.0)]


if __name__ == "__main__":
    for seed in range(int(sys.argv[1]), int(sys.argv[2])):
        scenario = sys.argv[3] if len(sys.argv) > 3 else "typical"
        missed, false = matched(*search(seed, scenario))
        print(seed, "missed", missed, "false", false)
