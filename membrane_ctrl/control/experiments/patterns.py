"""Flows in time for `machine.Patterned`, sized so that the mirror stays within a few um.

Each takes the identified gain: the same excursion on a strong and a weak pump.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from membrane_ctrl.control.experiments.machine import Around

Pattern = Callable[[float], float]

_SHARE = 0.25  # of the excursion limit: the weather, the pull and the laser's noise need the rest


def steps(around: Around, gain: float, hold_s: float = 2.0) -> Pattern:
    """Up, back, down, back, each for `hold_s`: what the eye wants to see."""
    up, down = room(around)
    size = min(up, down, _SHARE * around.limit_um / (gain * hold_s))
    levels = (size, 0.0, -size, 0.0)
    return lambda time_s: levels[int(time_s / hold_s) % 4]


def doublets(around: Around, gain: float, pulse_s: float = 0.3) -> Pattern:
    """Short pulses up, each followed by as much down: many steep edges, which is what tells dead time from lag.

    The way down is as small as the leak, so it takes longer; the mean flow is the holding flow.
    """
    up, down = room(around)
    size = min(up, _SHARE * around.limit_um / (gain * pulse_s))
    down = min(down, size)
    period_s = pulse_s * (1 + size / down)
    return lambda time_s: size if time_s % period_s < pulse_s else -down


def multisine(
    around: Around, gain: float, slowest_rad_per_s: float = 0.3, fastest_rad_per_s: float = 6.0, tones: int = 12
) -> Pattern:
    """Sines evenly spaced in the logarithm of frequency, of equal excursion up to the pump's room.

    Phases by Schroeder (1970), -pi n (n - 1) / N, which keep the peak low.
    """
    w = np.geomspace(slowest_rad_per_s, fastest_rad_per_s, tones)
    phases = -math.pi * np.arange(tones) * np.arange(1, tones + 1) / tones
    amplitudes = np.sqrt(w)  # flow between equal flow and equal excursion
    time_s = np.arange(0.0, 4 * math.pi / slowest_rad_per_s, 0.05)[:, None]
    flow = (amplitudes * np.sin(w * time_s + phases)).sum(axis=1)
    way = (amplitudes / w * np.cos(w * time_s + phases)).sum(axis=1)
    scale = min(min(room(around)) / np.abs(flow).max(), _SHARE * around.limit_um / (gain * np.abs(way).max()))
    return lambda now_s: float(scale * (amplitudes * np.sin(w * now_s + phases)).sum())


def room(around: Around) -> tuple[float, float]:
    """Flow above and below the holding flow. Raises ValueError without any: the mirror is too tight or too leaky."""
    up = around.full_flow_um_per_s - around.holding_flow_um_per_s
    down = around.holding_flow_um_per_s - around.least_flow_um_per_s
    if min(up, down) <= 0:
        raise ValueError(
            f"no room about the holding flow of {around.holding_flow_um_per_s:.2f} um/s in the pump's range of "
            f"{around.least_flow_um_per_s:.2f} .. {around.full_flow_um_per_s:.2f} um/s: "
            + ("open the bleed" if down <= 0 else "find the leak")
        )
    return up, down
