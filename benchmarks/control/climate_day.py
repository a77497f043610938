"""A day of +-2 K and +-10 % of humidity in the twin: focus and figure by what is held, in virtual
time.

The limit of one actuator is what the best sag at each moment would leave of the figure's change.
"""

from __future__ import annotations

import numpy as np

from tests.studies.climate_day import run_climate_day
from tests.support.figures import Figure, at_least, at_most

HOURS = 24.0


def run() -> list[Figure]:
    """A day with the vertex held, with the focus, and with the best fit."""
    figures = []
    for holds in ("vertex", "focus", "best_fit"):
        day = run_climate_day(holds, HOURS)
        limit_um = float(day.least_um.max())
        focus = f"{holds}: largest change of the focus"
        if holds == "vertex":
            figures.append(at_least(focus, float(np.abs(day.focus_um).max()), "um", 100.0))
        elif holds == "focus":
            figures.append(at_most(focus, float(np.abs(day.focus_um).max()), "um", 20.0))
        else:
            figures.append(at_most(focus, float(np.abs(day.focus_um).max()), "um"))
        figures.append(
            at_most(
                f"{holds}: largest RMS change of the figure",
                float(day.figure_um.max()),
                "um",
                None if holds == "vertex" else 1.1 * limit_um,
                "limit of one actuator",
                limit_um,
            )
        )
        figures.append(at_most(f"{holds}: faults", float(len(day.faults)), "", 0.0))
    return figures
