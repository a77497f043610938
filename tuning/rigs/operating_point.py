"""Operating point of an experiment, from the record of the hold before it."""

import math

import numpy as np

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control import pump_curve
from membrane_ctrl.control.experiments import operating_point
from tuning.identification.record import Record


def make_operating_point(
    held: Record, loop: LoopConfig, pump: PumpConfig, limit_um: float
) -> operating_point.OperatingPoint:
    """Operating point of an experiment, from the hold before it and the pump's range."""
    return operating_point.OperatingPoint(
        holding_flow_um_per_s=float(held.flow_um_per_s.mean()),
        least_flow_um_per_s=pump_curve.PumpCurve(pump).least_flow_um_per_s,
        full_flow_um_per_s=loop.flow_most_um_per_s(pump),
        laser_um=estimate_laser_noise_um(held),
        limit_um=limit_um,
    )


def estimate_laser_noise_um(record: Record) -> float:
    """Standard deviation of a reading, from differences of successive readings: the mirror hardly
    moves in a tick.

    Uses the median, so that jumps do not count. Raises ValueError for fewer than two readings.
    """
    steps_um = np.diff(record.displacement_um[np.isfinite(record.displacement_um)])
    if steps_um.size == 0:
        raise ValueError("no reading of the mirror in the record")
    return float(np.median(np.abs(steps_um)) / 0.6745 / math.sqrt(2))
