"""Tracker of a slow drift in noisy readings: value and rate, with fading memory.

Least squares of a straight line through all readings, each weighted by exp(-age / T). For readings a step dt apart,
with beta = exp(-dt / T) and r = reading - prediction (Morrison, Introduction to Sequential Smoothing and Prediction,
1969, degree-1 polynomial with fading memory):

    value += (1 - beta^2) r,    rate += (1 - beta)^2 r / dt

Both poles lie at beta: critically damped. A steady drift is followed without error (a single lag would stay behind
by rate x T). A drift of rate v that begins suddenly is behind by v t exp(-t / T): at most v T / e. Noise of
standard deviation sigma a reading comes through as sigma sqrt(1.25 dt / T).
"""

from __future__ import annotations

import math


class DriftTracker:
    """Value and rate of a drift that is 0 at the beginning.

    Parameters
    ----------
    memory_s : float
        T, the memory's time constant.
    """

    def __init__(self, memory_s: float) -> None:
        self._memory_s = memory_s
        self._time_s = math.nan
        self._value_um = 0.0
        self._rate_um_per_s = 0.0

    def begin(self, time_s: float) -> None:
        """The drift is 0 at this time, and its rate is taken for 0.

        A short memory at first would find an old drift sooner, but its noise would move a mirror that stands still.
        """
        self._time_s = time_s
        self._value_um = self._rate_um_per_s = 0.0

    def at(self, time_s: float) -> float:
        """Value in um expected at a time (not before the last reading's); a rate is believed for one memory."""
        return self._value_um + self._rate_um_per_s * min(time_s - self._time_s, self._memory_s)

    def take(self, reading_um: float, time_s: float) -> None:
        """Take a reading, later than the last one, into the memory."""
        dt_s = time_s - self._time_s
        beta = math.exp(-dt_s / self._memory_s)
        expected_um = self.at(time_s)
        residual_um = reading_um - expected_um
        self._value_um = expected_um + (1.0 - beta**2) * residual_um
        self._rate_um_per_s += (1.0 - beta) ** 2 * residual_um / dt_s
        self._time_s = time_s
