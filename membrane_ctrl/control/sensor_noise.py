"""Noise levels learned from the readings themselves, slowly and within bounds of what was configured. Pure."""

import math
from collections import deque

_MEMORY_S = 100.0
_LAG_S = 1.0  # of the longer difference
_NOISE_BOUND, _WALK_BOUND = 5.0**2, 30.0**2  # times and parts of the configured variance
_OUTLIER2 = 25.0
_BLOCK_S, _GAIN, _FACTOR_BOUND = 0.5, 0.02, 100.0  # of `Whiteness`


def _within(value: float, configured: float, bound: float) -> float:
    return min(max(value, configured / bound), configured * bound)


def _squared(difference: float, mean: float) -> float:
    """The square of a difference, limited to some times the mean square: an outlier is no noise."""
    return min(abs(difference), math.sqrt(_OUTLIER2 * mean)) ** 2


class WalkNoise:
    """Variance of a reading's noise, and of the walk per second under it.

    Squared differences of readings a tick and a second apart are 2 r + q dt and 2 r + q 1 s.
    """

    def __init__(self, noise: float, walk_per_root_s: float, rate_hz: float) -> None:
        self._noise, self._walk = noise**2, walk_per_root_s**2
        steps = max(2, round(_LAG_S * rate_hz))
        self._values: deque[float] = deque(maxlen=steps + 1)
        self._lag_s = steps / rate_hz
        self._short = 2 * self._noise + self._walk / rate_hz
        self._long = 2 * self._noise + self._walk * self._lag_s
        self._period_s = 1 / rate_hz
        self.variance, self.walk = self._noise, self._walk

    def update(self, value: float, dt_s: float) -> None:
        """Take a reading."""
        values = self._values
        if values:
            share = dt_s / _MEMORY_S
            self._short += share * (_squared(value - values[-1], self._short) - self._short)
            if len(values) == values.maxlen:
                self._long += share * (_squared(value - values[0], self._long) - self._long)
                walk = (self._long - self._short) / (self._lag_s - self._period_s)
                self.walk = _within(walk, self._walk, _WALK_BOUND)
                self.variance = _within((self._short - self.walk * self._period_s) / 2, self._noise, _NOISE_BOUND)
        values.append(value)


class Whiteness:
    """Factor on a walk's variance that makes a filter's innovations white.

    Means of innovations over blocks correlate positively where the filter follows too slowly, negatively where it
    follows noise.
    """

    def __init__(self) -> None:
        self.factor = 1.0
        self._block_s = math.nan
        self._sum = self._spread = 0.0
        self._last = math.nan

    def update(self, innovation: float, spread: float, now_s: float) -> None:
        """Take an innovation and its expected variance."""
        if math.isnan(self._block_s):
            self._block_s = now_s
        self._sum += innovation
        self._spread += spread
        if now_s - self._block_s < _BLOCK_S:
            return
        mean = max(-3.0, min(3.0, self._sum / math.sqrt(self._spread)))
        if math.isfinite(self._last):
            step = _GAIN * mean * self._last
            self.factor = min(max(self.factor * math.exp(step), 1 / _FACTOR_BOUND), _FACTOR_BOUND)
        self._last, self._block_s = mean, now_s
        self._sum = self._spread = 0.0
