"""Patterns of flow in time, sized so that the mirror stays within a few µm. Pure.

Each takes the identified gain, so that the excursion is the same on a strong and a weak pump.
"""

import math
from collections.abc import Callable

import numpy as np

from membrane_ctrl.control.experiments import operating_point

Pattern = Callable[[float], float]
_SHARE = 0.25  # of the excursion limit: the weather, the pull and the laser's noise need the rest


def make_steps(around: operating_point.OperatingPoint, gain: float, hold_s: float = 2.0) -> Pattern:
    """Make steps of the flow: up, back, down, back. Easy to judge by eye.

    Parameters
    ----------
    around : OperatingPoint
        Its range and its limit bound the steps.
    gain : float
        k of the mirror, as known so far.
    hold_s : float
        Duration of each level.
    """
    up, down = operating_point.require_room(around)
    size = min(up, down, _SHARE * around.limit_um / (gain * hold_s))
    levels = (size, 0.0, -size, 0.0)
    return lambda time_s: levels[int(time_s / hold_s) % 4]


def make_doublets(
    around: operating_point.OperatingPoint, gain: float, pulse_s: float = 0.3
) -> Pattern:
    """Make doublets: short pulses up, each followed by an equal one down.

    Their many steep edges separate dead time from lag. The downward flow is limited by the leak, so
    it takes longer; the mean flow is the holding flow.

    Parameters
    ----------
    around : OperatingPoint
        Its range and its limit bound the pulses.
    gain : float
        k of the mirror, as known so far.
    pulse_s : float
        Duration of a pulse up.
    """
    up, down = operating_point.require_room(around)
    size = min(up, _SHARE * around.limit_um / (gain * pulse_s))
    down = min(down, size)
    period_s = pulse_s * (1 + size / down)
    return lambda time_s: size if time_s % period_s < pulse_s else -down


def make_multisine(
    around: operating_point.OperatingPoint,
    gain: float,
    slowest_rad_per_s: float = 0.3,
    fastest_rad_per_s: float = 6.0,
    tones: int = 12,
) -> Pattern:
    """Return sines evenly spaced in the logarithm of frequency, of equal excursion of the centre.

    Phases by Schroeder (1970), -pi n (n - 1) / N, which keep the peak low.

    Parameters
    ----------
    around : OperatingPoint
        Range of the pump, and limit of the excursion.
    gain : float
        Speed of the centre over the flow.
    slowest_rad_per_s, fastest_rad_per_s : float
        The lowest and the highest frequency.
    tones : int
        Number of sines.

    Returns
    -------
    Pattern
        Flow over time, added to the holding flow.
    """
    w = np.geomspace(slowest_rad_per_s, fastest_rad_per_s, tones)
    phases = -math.pi * np.arange(tones) * np.arange(1, tones + 1) / tones
    amplitudes = np.sqrt(w)  # flow between equal flow and equal excursion
    # Flow and excursion over the slowest period, for their peaks
    time_s = np.arange(0.0, 4 * math.pi / slowest_rad_per_s, 0.05)[:, None]
    flow = (amplitudes * np.sin(w * time_s + phases)).sum(axis=1)
    way = (amplitudes / w * np.cos(w * time_s + phases)).sum(axis=1)
    # As large as the pump's range and the limit of the excursion allow
    scale = min(
        min(operating_point.require_room(around)) / np.abs(flow).max(),
        _SHARE * around.limit_um / (gain * np.abs(way).max()),
    )
    return lambda now_s: float(scale * (amplitudes * np.sin(w * now_s + phases)).sum())
