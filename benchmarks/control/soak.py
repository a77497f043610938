"""Days of simulated hold with weather, daily temperature, creep and random faults; memory must not
grow.

python -m benchmarks.control.soak [--days 30] [--seed 1]
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from membrane_ctrl.hold.virtual_run import VirtualTick
from membrane_ctrl.model import telemetry
from tests.studies.soak import (
    DAY_S,
    MINUTE_BAND_UM,
    Take,
    dropout_excursions_um,
    everything,
    rss_mb,
    soak,
)
from tests.support.figures import Figure, at_least, at_most, show


def figures(days: float, seed: int = 1, take: Take | None = None) -> list[Figure]:
    """A soak of `days` with everything, as figures."""
    tally = soak(days, seed, True, everything(seed), take)
    days = tally.days  # fewer if stopped
    grown = 100 * (tally.rss_mb / tally.rss_after_hour_mb - 1)
    return [
        at_most("simulated days, with weather and faults", days, "d"),
        at_least("speed against real time", days * DAY_S / tally.wall_s, "", 1000.0),
        at_least("held", 100 * tally.held_s / (days * DAY_S), "% of the time", 98.0),
        at_most("faults, latched or cleared", tally.events["fault"], ""),
        at_most(
            "standard deviation of the true centre", (tally.square_um2 / tally.ticks) ** 0.5, "um"
        ),
        at_least("1 s means within 2 µm", 100 * tally.second.fraction, "%", 99.9),
        at_least("60 s means within 0.5 µm", 100 * tally.minute.fraction, "%", 99.0),
        at_most(
            "growth of memory since the first hour",
            grown,
            "%",
            5.0,
            "MB after it",
            tally.rss_after_hour_mb,
        ),
        at_most("events", tally.event_bytes / days / 1e3, "kB a day"),
    ]


def run() -> list[Figure]:
    """A day of typical weather (more seeds: tests/campaign), the laser lost,
    a day with everything.
    """
    day = soak(1.0, 1, faults=False)
    excursions_um = dropout_excursions_um()
    return [
        at_least("24 h typical: 1 s means within 2 µm", 100 * day.second.fraction, "%", 99.9),
        at_most("24 h typical: worst 60 s mean", day.minute.worst_um, "um", MINUTE_BAND_UM),
        at_most("24 h typical: standard deviation", (day.square_um2 / day.ticks) ** 0.5, "um"),
        at_most(
            "10 s without laser, worst of 12 seeds: excursion of the true centre",
            max(excursions_um),
            "um",
            4.0,
        ),
        at_most("10 s without laser, mean of 12 seeds", float(np.mean(excursions_um)), "um"),
        *figures(1.0),
    ]


def _print_days(tick: VirtualTick) -> None:
    """Print a line per simulated day."""
    day, second = divmod(tick.row.mono_s, DAY_S)
    if second < tick.row.dt_s / 2:
        state = telemetry.State(int(tick.row.state)).name.lower()
        print(
            f"day {day:.0f}: {state}, {rss_mb():.1f} MB",
            file=sys.stderr,
            flush=True,
        )


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--days", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    found = figures(options.days, options.seed, _print_days)
    show("soak", found)
    return int(any(figure.met is False for figure in found))


if __name__ == "__main__":
    sys.exit(main())
