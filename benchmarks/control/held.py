"""The true centre in typical weather at 50 Hz and 1 µm of laser noise, in virtual time: four seeds
of five minutes.

The reference is the least standard deviation any controller could reach with the same sensors
(minimum variance).
"""

from __future__ import annotations

from tests.studies.inner_loop import SENSORS, steady
from tests.support.figures import Figure, at_least, at_most

SEEDS = range(1, 5)
DURATION_S = 300.0


def run() -> list[Figure]:
    """Laser alone, and with the feed-forward from barometer and thermometer."""
    figures = []
    laser_only, *_, with_both = SENSORS
    for sensors, limit_um in ((laser_only, 0.25), (with_both, 0.15)):
        s = steady(sensors, "typical", SEEDS, DURATION_S)
        figures += [
            at_most(
                f"{sensors}: standard deviation, mean of seeds",
                s["std_um"],
                "um",
                limit_um,
                "least",
                s["least_std_um"],
            ),
            at_most(
                f"{sensors}: standard deviation, worst seed", s["worst_std_um"], "um", limit_um
            ),
            at_most(f"{sensors}: worst |bias|", s["worst_bias_um"], "um", 0.1),
            at_least(f"{sensors}: 1 s means within +-2 µm", s["in_band_1s_fraction"], "", 1.0),
        ]
    return figures
