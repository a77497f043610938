"""Filters of single signals: first-order for unequal steps, drift, noise levels learned from the readings. Pure."""

import math
from collections import deque


def smoothing(dt_s: float, time_constant_s: float) -> float:
    """Step fraction of a first-order lag, 1 - exp(-dt / T); 1 without a lag."""
    return -math.expm1(-dt_s / time_constant_s) if time_constant_s > 0 else 1.0


class LowPass:
    """First-order lag that starts at its first input; a time constant of 0 passes the input through."""

    def __init__(self, time_constant_s: float) -> None:
        self.time_constant_s = time_constant_s
        self.value = math.nan

    def reset(self, value: float) -> None:
        """Stand still at `value`; NaN: start at the next input."""
        self.value = value

    def update(self, given: float, dt_s: float) -> float:
        """Output after `given` was applied for `dt_s`."""
        if math.isnan(self.value):
            self.value = given
        self.value += smoothing(dt_s, self.time_constant_s) * (given - self.value)
        return self.value


class LagRate:
    """Rate of change of a signal behind a first-order lag, (x - lag(x)) / T, that survives the signal's absence.

    The mean rate over a step is the lag's change divided by the step, so that the rate integrates exactly to the
    lag's own movement; T = 0 gives the plain difference quotient. While the signal is absent (NaN) the last value
    stands and the rate decays; on its return the lag is placed so that the rate continues from its present value:
    neither makes a bump. A step of more than `step_max` counts as an absence.
    """

    def __init__(self, time_constant_s: float, step_max: float = math.inf) -> None:
        self.time_constant_s = time_constant_s
        self.rate_per_s = 0.0
        self._step_max = step_max
        self._input = math.nan
        self._lag = math.nan
        self._absent = True

    def update(self, given: float, dt_s: float) -> float:
        """Mean rate per second over the step; `given` may be NaN."""
        share = smoothing(dt_s, self.time_constant_s)
        if math.isfinite(given):
            if self._absent or abs(given - self._input) > self._step_max:
                self._lag = given - self.rate_per_s * dt_s / share
            self._input = given
        self._absent = not math.isfinite(given)
        if math.isfinite(self._input):
            moved = share * (self._input - self._lag)
            self._lag += moved
            self.rate_per_s = moved / dt_s
        return self.rate_per_s


# Slope of a straight line through samples as they come.


class Slope:
    """Least-squares slope of y over t, from running sums; times are counted from the first sample.

    With n evenly spread samples of noise sigma over a span T its standard deviation is sigma sqrt(12 / n) / T:
    0.25 um/s for 1 um, 50 Hz and 1.5 s.
    """

    def __init__(self) -> None:
        self._start_s = math.nan
        self._n = 0
        self._t = self._y = self._tt = self._ty = 0.0

    def add(self, time_s: float, value: float) -> None:
        """Add one sample, ignoring one that is not finite."""
        if not math.isfinite(value):
            return
        if self._n == 0:
            self._start_s = time_s
        t = time_s - self._start_s
        self._n += 1
        self._t += t
        self._y += value
        self._tt += t * t
        self._ty += t * value

    @property
    def per_s(self) -> float:
        """The slope, 0 until there are two different times."""
        spread = self._n * self._tt - self._t * self._t
        return (self._n * self._ty - self._t * self._y) / spread if spread > 0 else 0.0


# Tracker of a slow drift in noisy readings: value and rate, with fading memory.
#
# Least squares of a straight line through all readings, each weighted by exp(-age / T). For readings a step dt apart,
# with beta = exp(-dt / T) and r = reading - prediction (Morrison, Introduction to Sequential Smoothing and
# Prediction, 1969, degree-1 polynomial with fading memory):
#
#     value += (1 - beta^2) r,    rate += (1 - beta)^2 r / dt
#
# Both poles lie at beta: critically damped. A steady drift is tracked without error (a single lag would trail
# by rate x T). After a sudden onset of a drift v the tracker trails by v t exp(-t / T): at most v T / e. Noise of
# standard deviation sigma per reading becomes sigma sqrt(1.25 dt / T).


class DriftTracker:
    """Value and rate of a drift that is initially 0; T is `memory_s`, which may change."""

    def __init__(self, memory_s: float) -> None:
        self.memory_s = memory_s
        self._time_s = math.nan
        self._value_um = 0.0
        self._rate_um_per_s = 0.0

    def begin(self, time_s: float) -> None:
        """Set drift and rate to 0 at this time.

        An initially short memory would find an old drift sooner, but its noise would move a still mirror.
        """
        self._time_s = time_s
        self._value_um = self._rate_um_per_s = 0.0

    def at(self, time_s: float) -> float:
        """Value in um expected at a time (not before the last reading's); a rate is believed for one memory."""
        return self._value_um + self._rate_um_per_s * min(time_s - self._time_s, self.memory_s)

    def take(self, reading_um: float, time_s: float) -> None:
        """Take a reading, later than the last one, into the memory."""
        dt_s = time_s - self._time_s
        beta = math.exp(-dt_s / self.memory_s)
        expected_um = self.at(time_s)
        residual_um = reading_um - expected_um
        self._value_um = expected_um + (1.0 - beta**2) * residual_um
        self._rate_um_per_s += (1.0 - beta) ** 2 * residual_um / dt_s
        self._time_s = time_s


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
