"""Minutes of the twin's climate at its steepest: what is held stays, by code that shares
nothing with the product.
"""

from __future__ import annotations

import numpy as np

from tests.studies.climate_day import run_climate_day

HOURS, RATE_HZ = 0.2, 2.0


def test_the_focus_stays_in_a_changing_climate() -> None:
    """The film's excess strain changes by 7e-6: some 60 µm of focus at a constant vertex."""
    day = run_climate_day("focus", HOURS, RATE_HZ)
    assert not day.faults
    assert np.ptp(day.excess_ppm) > 6.0
    assert np.abs(day.focus_um).max() < 20.0
    # One actuator leaves the spherical aberration, and nothing else is added
    assert day.figure_um.max() < 1.1 * day.least_um.max()
