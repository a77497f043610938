"""Shows one rule of the safety table at work and in lists: a program that a changed copy of the
source runs.

python rule_bench.py RULE FIELD VALUE: holds the twin in virtual time, lets a field of the device's
answer take a value, and prints as JSON what happens; which mutant removes the rule, and where; and
its row in the fault matrix.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[3]
for folder in (ROOT / "tests" / "campaign", ROOT / "tests" / "mutants", ROOT):
    sys.path.insert(0, str(folder))

import campaign  # noqa: E402
import mutants  # noqa: E402

from firmware_iface.roles import BenchReading  # noqa: E402
from membrane_ctrl.config.schema import Config  # noqa: E402
from membrane_ctrl.controller.command import Command  # noqa: E402
from membrane_ctrl.hold.virtual_run import VirtualRun  # noqa: E402
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection  # noqa: E402
from membrane_ctrl.model.events import Fault, StateEntered  # noqa: E402
from membrane_ctrl.sim.plant import Plant  # noqa: E402
from membrane_ctrl.sim.virtual_bench import VirtualBench  # noqa: E402

BEGINS_S, ENDS_S = 40.0, 50.0


def hold_with(field: str, value: float) -> list[dict[str, Any]]:
    """Faults and states from the moment at which the field takes the value."""

    def alter(now_s: float, reading: BenchReading) -> BenchReading:
        return replace(reading, **{field: value}) if now_s >= BEGINS_S else reading

    config = Config.model_validate(
        {"twin": {"scenario": "quiet"}, "states": {"stay_after_trip": True}}
    )
    bench = VirtualBench(Plant(config.twin, config.pump))
    run = VirtualRun(config, bench, zernike_projection(), alter=alter)
    commands: tuple[Command, ...] = (Command("hold", "campaign"),)
    found: list[dict[str, Any]] = []
    while run.now_s < ENDS_S:
        tick = run.run_tick(commands)
        commands = ()
        if tick is not None and run.now_s >= BEGINS_S:
            found += [
                event.to_dict() for event in tick.events if isinstance(event, Fault | StateEntered)
            ]
    return found


def main() -> None:
    """Print everything."""
    rule, field, value = sys.argv[1], sys.argv[2], float(sys.argv[3])
    mutant = next(each for each in mutants.load()[0] if each.rule == rule)
    shown = {
        "events": hold_with(field, value),
        "mutant": {
            "what": mutant.what,
            "place": str(mutant.place(mutants.ROOT).relative_to(mutants.ROOT)),
        },
        "matrix": [line for line in campaign.document([], []).splitlines() if f"`{rule}`" in line],
    }
    print(json.dumps(shown))


if __name__ == "__main__":
    main()
