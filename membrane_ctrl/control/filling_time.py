"""How long the leak takes to lower a mirror, and the pump to fill it.

The outflow is proportional to the gauge pressure p, and the sag w to its cube root (a Hencky bowl),
as the volume to the sag. With the speed L at which the leak lowers the centre of the full mirror of
sag w0, and the speed F at which the pump alone lifts it,

    dw/dt = F - L (w / w0)^3.
"""

from __future__ import annotations

import math

import numpy as np

_STEPS = 1000  # of the integral: exact to 1e-6 of it


def find_leak_speed(sag_mm: float, time_constant_s: float) -> float:
    """Speed at which a leak lowers the centre: w0 / (3 T).

    Parameters
    ----------
    sag_mm : float
        w0.
    time_constant_s : float
        T of the pressure.

    Returns
    -------
    float
        In µm/s.
    """
    return 1e3 * sag_mm / (3.0 * time_constant_s)


def find_fall_s(sag_mm: float, pressure_pa: float, end_pa: float, leak_um_per_s: float) -> float:
    """Time until the leak alone has lowered the pressure of the full mirror to `end_pa`.

    Parameters
    ----------
    sag_mm, pressure_pa : float
        Of the full mirror.
    end_pa : float
        More than 0 and less than that.
    leak_um_per_s : float
        Speed of the centre of the full mirror.

    Returns
    -------
    float
        Infinite without a leak.
    """
    if not leak_um_per_s > 0.0:
        return math.inf
    relative_sag_squared = float((pressure_pa / end_pa) ** (2 / 3))
    return 0.5 * 1e3 * sag_mm / leak_um_per_s * (relative_sag_squared - 1.0)


def find_filling_s(sag_mm: float, flow_um_per_s: float, leak_um_per_s: float) -> float:
    """Time to fill a flat mirror to its sag with a flow, against the leak.

    Parameters
    ----------
    sag_mm : float
        Of the full mirror.
    flow_um_per_s : float
        Speed at which the pump alone lifts the centre.
    leak_um_per_s : float
        Speed at which the leak lowers the centre of the full mirror.

    Returns
    -------
    float
        Infinite if the leak of the full mirror is not less than the flow.
    """
    if not flow_um_per_s > max(leak_um_per_s, 0.0):
        return math.inf
    share = (np.arange(_STEPS) + 0.5) / _STEPS
    speed_um_per_s = flow_um_per_s - leak_um_per_s * share**3
    return float(1e3 * sag_mm * np.mean(1.0 / speed_um_per_s))
