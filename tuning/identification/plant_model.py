"""Model of the mirror for tuning: an integrator behind the pump's transport delay and lag.

    dy/dt = k q(t) - leak + disturbance,    T dq/dt = v(t - theta) - q

v is the commanded flow on the pump's nominal curve, as speed of the centre: k = 1 on a bench as
configured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from tuning.identification.record import Record, Series


@dataclass(frozen=True, slots=True)
class PlantModel:
    """Gain, delay and leak.

    Attributes
    ----------
    gain : float
        k, speed of the centre per commanded flow.
    dead_time_s : float
        theta, from a reading's tick to the first gas in the mirror (half a sample of holding comes
        on top).
    lag_s : float
        T.
    leak_um_per_s : float
        Loss through leak and bleed.
    """

    gain: float
    dead_time_s: float
    lag_s: float
    leak_um_per_s: float

    @property
    def delay_s(self) -> float:
        """Dead time plus lag, the delay of a ramp."""
        return self.dead_time_s + self.lag_s

    @property
    def holding_flow_um_per_s(self) -> float:
        """Commanded flow that balances the leak."""
        return self.leak_um_per_s / self.gain


def delay_series(series: Series, delay_s: float, dt_s: float) -> Series:
    """Return a series as it was some time ago, linear between samples.

    Parameters
    ----------
    series : (n,) array
        The values.
    delay_s : float
        How long ago.
    dt_s : float
        Time between samples.

    Returns
    -------
    (n,) array
        The first value stands for those before the record.
    """
    if delay_s == 0:
        return series
    ticks = np.arange(series.size, dtype=float)
    return np.asarray(np.interp(ticks - delay_s / dt_s, ticks, series), dtype=float)


def compute_driven_um(
    flow_um_per_s: Series, dead_time_s: float, lag_s: float, dt_s: float
) -> Series:
    """Compute the path of the centre for unit gain, for a flow held between readings; exact.

    From T dq/dt = v - q follows the integral of q = integral of v - T q (+ constant). The integral
    of a held flow is a broken line, so interpolating it between samples is exact for any delay.
    Within a sample the delayed flow changes once, after the share f of the sample: q[i+1] = a q[i]
    + b1 v[i-m-1] + b2 v[i-m].

    Parameters
    ----------
    flow_um_per_s : (n,) array
        Commanded flow from each reading to the next; before the record it is equal to the first.
    dead_time_s, lag_s : float
        theta and T.
    dt_s : float
        Sample time.

    Returns
    -------
    (n,) array
        In µm at each reading; 0 at the first.
    """
    # The path without the lag: the delayed integral of the flow's changes.
    first = flow_um_per_s[0]
    change = flow_um_per_s - first
    integral = np.concatenate(([0.0], np.cumsum(change[:-1]) * dt_s))
    way = delay_series(integral, dead_time_s, dt_s)

    # Less T q: the recurrence of q, with the weights of the two flows within a sample.
    if lag_s > 0:
        whole = math.floor(dead_time_s / dt_s)
        part = dead_time_s / dt_s - whole
        left_s = (1.0 - part) * dt_s
        decay = math.exp(-dt_s / lag_s)
        earlier = math.exp(-left_s / lag_s) - decay
        later = -math.expm1(-left_s / lag_s)
        weights = np.concatenate((np.zeros(whole + 1), [later, earlier]))
        way = way - lag_s * np.asarray(lfilter(weights, [1.0, -decay], change))

    # The steady flow's own path.
    ticks = np.arange(flow_um_per_s.size)
    return np.asarray(way + first * dt_s * ticks, dtype=float)


def compute_pump_share_um(record: Record, model: PlantModel) -> Series:
    """Return the motion of the centre due to pump and leak alone.

    Parameters
    ----------
    record : Record
        n ticks with the commanded flow.
    model : PlantModel
        The plant.

    Returns
    -------
    (n,) array
        µm, with the mean of the record's readings.
    """
    x = compute_driven_um(record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s)
    leaked_um = model.leak_um_per_s * np.arange(len(record)) * record.dt_s
    way_um = model.gain * x - leaked_um
    return way_um + float(np.mean(record.filled_displacement_um() - way_um))
