"""Operating point of an experiment, from the record of the hold before it."""

import math

import numpy as np

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control import pump_curve
from membrane_ctrl.control.experiments import operating_point
from tuning.identification.record import Record, Series

_CHANGES_LEAST = 0.95  # share of readings that differ from the one before, of a usual sensor
_FINE_STEP = 0.5  # of the noise; a larger least step is that of a coarse sensor
_USUAL = 0.99  # quantile of the differences; larger ones are jumps


def make_operating_point(
    held: Record, loop: LoopConfig, pump: PumpConfig, limit_um: float
) -> operating_point.OperatingPoint:
    """Operating point of an experiment.

    Parameters
    ----------
    held : Record
        The hold before it: mean flow and noise of a reading.
    loop, pump : LoopConfig, PumpConfig
        The range of the flow.
    limit_um : float
        How far the mirror may move from its setpoint.
    """
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

    Uses the median, so that jumps do not count. A sensor slower than the ticks repeats its samples,
    and one with coarse steps reads the same value often. Both make equal readings, and a median of
    0. Their least step shows which: it is small beside the noise of a slow sensor, and
    as large as the noise of a coarse one. Raises ValueError for fewer than two readings.
    """
    readings_um = record.displacement_um[np.isfinite(record.displacement_um)]
    steps_um = np.abs(np.diff(readings_um))
    if steps_um.size == 0:
        raise ValueError("no reading of the mirror in the record")
    changes_um = steps_um[steps_um > 0]
    if changes_um.size == 0:
        return 0.0
    of_changes_um = _scale_from_median(changes_um)

    # A usual sensor, one that repeats its samples, or one with coarse steps?
    if changes_um.size >= _CHANGES_LEAST * steps_um.size:
        return _scale_from_median(steps_um)
    if changes_um.min() < _FINE_STEP * of_changes_um:
        return of_changes_um  # repeated samples say nothing of the noise
    # coarse steps: their mean square, without jumps
    most_um = np.quantile(steps_um, _USUAL)
    return float(np.sqrt(np.mean(np.minimum(steps_um, most_um) ** 2) / 2.0))


def _scale_from_median(steps_um: Series) -> float:
    """Standard deviation of readings whose differences have these sizes, if they are Gaussian."""
    # A Gaussian's median size is 0.6745 of its standard deviation; a difference has two errors.
    return float(np.median(steps_um) / 0.6745 / math.sqrt(2))
