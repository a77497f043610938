"""Tests whether the pump is as strong above the holding flow as below.

A saturating or stalling pump is not. A relay has two flows, and a straight line goes through any
two points; the holds about it are the third. A pump that saturates is then a weak one to a fit with
a single gain, and gains made for that are too high for what the loop does every second about the
holding flow. So the record is fitted once more with a difference d between two gains,

    y = k x + d x_above - leak t + n,    x_above: the way by max(v - mean v, 0),

with dead time, lag and noise of the fit. What is left of x_above when x and t have taken their
share (r) decides: d = r y / r r, with the standard error sigma / |r| (Frisch and Waugh,
Econometrica 1 (1933) 387).
"""

import math
from dataclasses import dataclass

import numpy as np

from tuning.identification import plant_model
from tuning.identification.plant_fit import Identified
from tuning.identification.record import Record, Series

_SAME = 1e-6  # with two flows in the whole record, x_above is x and t but for rounding


@dataclass(frozen=True, slots=True)
class TwoGains:
    """Gains of the pump above and below the holding flow.

    Attributes
    ----------
    below, above : float
        Gain of each part.
    difference_sigma : float
        Standard error of `above - below`; infinite if the flow had two values only.
    """

    below: float
    above: float
    difference_sigma: float


def fit_two_gains(record: Record, identified: Identified) -> TwoGains:
    """Fit gains below and above the mean flow of a record, which is the flow that holds.

    Parameters
    ----------
    record : Record
        The record of the fit.
    identified : Identified
        The fit with one gain.

    Returns
    -------
    TwoGains
    """
    model = identified.model
    dt_s = record.dt_s

    def compute_whitened_way(flow_um_per_s: Series) -> Series:
        """Increments of the path that a flow drives, filtered so that the noise is white."""
        way_um = plant_model.compute_driven_um(flow_um_per_s, model.dead_time_s, model.lag_s, dt_s)
        return identified.noise.whitened(np.diff(way_um), dt_s)

    # y without the pressure's share.
    moved_um = np.diff(record.filled_displacement_um())
    if identified.pressure_gain_um_per_pa != 0.0:
        moved_um -= identified.pressure_gain_um_per_pa * np.diff(record.ambient_pressure_pa)
    moved_um = identified.noise.whitened(moved_um, dt_s)

    # x and t, and x_above.
    leak_um = identified.noise.whitened(np.full(moved_um.size, -dt_s), dt_s)
    straight = np.column_stack([compute_whitened_way(record.flow_um_per_s), leak_um])
    flow_above = np.maximum(record.flow_um_per_s - record.flow_um_per_s.mean(), 0.0)
    above_um = compute_whitened_way(flow_above)

    # r: what is left of x_above when x and t have taken their share.
    explained = np.linalg.lstsq(straight, above_um, rcond=None)[0]
    rest_um = above_um - straight @ explained
    if np.linalg.norm(rest_um) < _SAME * np.linalg.norm(above_um):
        return TwoGains(model.gain, model.gain, math.inf)

    # d = r y / r r; then the gain below, from y without d x_above.
    difference = float(rest_um @ moved_um / (rest_um @ rest_um))
    without_difference_um = moved_um - difference * above_um
    below = float(np.linalg.lstsq(straight, without_difference_um, rcond=None)[0][0])
    sigma = identified.innovation_um / float(np.linalg.norm(rest_um))
    return TwoGains(below, below + difference, sigma)
