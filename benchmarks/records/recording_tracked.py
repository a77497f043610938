"""Bytes of a day of a hold that tracks, twenty figures a second through the real recorder: the
growth of its files.

The start of a run takes as much as minutes of it, so that two runs are compared.

python -m benchmarks recording_tracked
"""

from __future__ import annotations

from benchmarks.records.recording import DAY_S, recorded
from membrane_ctrl.config.schema import Config, ShapeConfig
from membrane_ctrl.run_files import table_specs
from tests.support.figures import Figure, at_most

SHORT_S, LONG_S = 60.0, 300.0
RATE_HZ = 20.0


def run() -> list[Figure]:
    """The benchmark."""
    config = Config(shape=ShapeConfig(mode="track", track_rate_hz=RATE_HZ))
    short, whole = (recorded(config, lasts_s) for lasts_s in (SHORT_S, LONG_S))
    mb = {
        files: (LONG_S * whole.mb_a_day[files] - SHORT_S * short.mb_a_day[files])
        / (LONG_S - SHORT_S)
        for files in whole.mb_a_day
    }
    return [
        at_most("20 tracked figures a second: their table", mb["tracked"], "MB a day", 150.0),
        at_most("of it a figure", 1e6 * mb["tracked"] / DAY_S / RATE_HZ, "bytes"),
        at_most("all tables", sum(mb[spec.name] for spec in table_specs.ALL), "MB a day", 300.0),
        at_most("Rerun segments of the first minutes, optimised", mb["*.rrd"], "MB a day"),
        at_most("recorder, share of a core", 100 * whole.busy, "%"),
    ]
