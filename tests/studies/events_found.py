"""Events of simulated nights, matched with those that the review finds."""

from __future__ import annotations

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.telemetry import get_column
from membrane_ctrl.review.events.found import find_events
from membrane_ctrl.review.events.found_event import FoundEvent
from membrane_ctrl.run_files.levels import TICK_FIELDS, first_level
from membrane_ctrl.run_files.shapes import Shapes
from tests.worlds.nights import DOOR, GLITCH, JUMP, LATE, LEAK, LOST, Planted, night, planted
from tests.worlds.synthetic_shape import from_estimates

# How far from the truth an event may be found, s: leaks are judged on minutes.
REACH_S = {DOOR: 4.0, LEAK: 240.0, GLITCH: 2.0, LOST: 7.0, LATE: 12.0, JUMP: 30.0}


def search(seed: int, scenario: str, hours: float = 8.0) -> tuple[list[Planted], list[FoundEvent]]:
    """Events planted in a night, and events found in it."""
    rng = np.random.default_rng(1000 + seed)
    events = planted(rng, hours)
    rows, estimates = night(seed, hours, scenario, events)
    level = first_level({name: get_column(rows, name) for name in TICK_FIELDS})
    shapes: Shapes = from_estimates(estimates)
    return events, find_events(level, shapes, Config().limits.band_um)


def matched(
    events: list[Planted], found: list[FoundEvent]
) -> tuple[list[Planted], list[FoundEvent]]:
    """Planted events not found, and found ones that nobody planted."""
    left = list(found)
    missed = []
    for event in events:
        near = [
            f
            for f in left
            if f.kind == event.kind and abs(f.time_s - event.time_s) <= REACH_S[event.kind]
        ]
        missed += [] if near else [event]
        left = [f for f in left if f not in near]
    # side effects of an event are no false alarm: a flow step raises the noise, a lost laser ends
    # in a spike
    return missed, [
        f for f in left if not any(abs(f.time_s - e.time_s) < 900 and _echo(f, e) for e in events)
    ]


def _echo(found: FoundEvent, event: Planted) -> bool:
    return found.kind == "noise change" and event.kind in {LEAK, DOOR, LOST, GLITCH}
