"""The error of a measured pump curve against the true pump."""

from __future__ import annotations

import numpy as np

from membrane_ctrl.control.pump_curve import PumpCurve
from tests.worlds import foreign_plant
from tuning.identification.pump_map import PumpMap


def worst_share(found: PumpMap, pump: foreign_plant.ForeignPump) -> float:
    """Largest error of the flow over the curve, from the start on, as a share of the full flow."""
    curve = PumpCurve(found.pump)
    low = max(found.pump.start_fraction, found.pump.curve_fraction[0])
    commands = np.linspace(low, found.pump.curve_fraction[-1], 100)
    return max(abs(curve._rising.flow(d) - pump.settled(d)) for d in commands) / pump.full_um_per_s
