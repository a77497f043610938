"""The mirror as tuning sees it: an integrator behind the pump's transport delay and lag.

    dy/dt = k q(t) - leak + disturbance,    T dq/dt = v(t - theta) - q

v is the commanded flow on the pump's nominal curve, as speed of the centre: k = 1 on a bench as configured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from tuning.records import Series


@dataclass(frozen=True, slots=True)
class PlantModel:
    """Gain, delay and leak.

    Attributes
    ----------
    gain : float
        k, speed of the centre per commanded flow.
    dead_time_s : float
        theta, from a reading's tick to the first gas in the mirror (half a sample of holding comes on top).
    lag_s : float
        T, of the pump.
    leak_um_per_s : float
        What leak and bleed take away.
    """

    gain: float
    dead_time_s: float
    lag_s: float
    leak_um_per_s: float

    @property
    def delay_s(self) -> float:
        """Dead time and lag together: what a ramp comes late by."""
        return self.dead_time_s + self.lag_s

    @property
    def holding_flow_um_per_s(self) -> float:
        """Commanded flow that makes up for the leak."""
        return self.leak_um_per_s / self.gain


def delayed(series: Series, delay_s: float, dt_s: float) -> Series:
    """Values `delay_s` ago, linear between samples; the first value before the record."""
    if delay_s == 0:
        return series
    ticks = np.arange(series.size, dtype=float)
    return np.asarray(np.interp(ticks - delay_s / dt_s, ticks, series), dtype=float)


def driven_um(flow_um_per_s: Series, dead_time_s: float, lag_s: float, dt_s: float) -> Series:
    """Way of the centre for unit gain, at each reading, for a flow held between readings; exact.

    From T dq/dt = v - q follows the integral of q = integral of v - T q (+ constant). The integral of a held flow is
    a broken line, so interpolating it between samples is exact for any delay. Within a sample the delayed flow
    changes once, after the share f of the sample: q[i+1] = a q[i] + b1 v[i-m-1] + b2 v[i-m].

    Parameters
    ----------
    flow_um_per_s : (n,) array
        v; its first value is taken to have stood for ever.
    dead_time_s, lag_s : float
    dt_s : float

    Returns
    -------
    (n,) array, 0 at the first reading.
    """
    first = flow_um_per_s[0]
    change = flow_um_per_s - first
    way = np.concatenate(([0.0], np.cumsum(change[:-1]) * dt_s))
    way = delayed(way, dead_time_s, dt_s)
    if lag_s > 0:
        whole = math.floor(dead_time_s / dt_s)
        left_s = (1.0 - (dead_time_s / dt_s - whole)) * dt_s
        late, now = math.exp(-left_s / lag_s) - math.exp(-dt_s / lag_s), -math.expm1(-left_s / lag_s)
        weights = np.concatenate((np.zeros(whole + 1), [now, late]))
        way = way - lag_s * np.asarray(lfilter(weights, [1.0, -math.exp(-dt_s / lag_s)], change))
    return np.asarray(way + first * dt_s * np.arange(flow_um_per_s.size), dtype=float)
