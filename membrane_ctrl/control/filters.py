"""Filters of single signals: first-order for unequal steps, drift; noise levels and ramps in innovations. Pure."""

import math


def smoothing(dt_s: float, time_constant_s: float) -> float:
    """Step fraction of a first-order lag, 1 - exp(-dt / T); 1 without a lag."""
    return -math.expm1(-dt_s / time_constant_s) if time_constant_s > 0 else 1.0


class LowPass:
    """First-order lag that starts at its first input; a time constant of 0 passes the input through.

    `early_mean`: the plain mean of its inputs at first, of which none weighs more than the others.
    """

    def __init__(self, time_constant_s: float, early_mean: bool = False) -> None:
        self.time_constant_s = time_constant_s
        self.value = math.nan
        self._age_s = 0.0 if early_mean else math.inf

    def reset(self, value: float) -> None:
        """Stand still at `value`; NaN: start at the next input."""
        self.value = value

    def update(self, given: float, dt_s: float) -> float:
        """Output after `given` was applied for `dt_s`."""
        self._age_s += dt_s
        if math.isnan(self.value):
            self.value = given
        share = dt_s / self._age_s if dt_s > 0 else 0.0
        self.value += max(smoothing(dt_s, self.time_constant_s), share) * (given - self.value)
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


_MEMORY_S = 200.0
_LIMIT = 3.0  # an innovation beyond this many standard deviations counts as this many
_READING_BOUND, _WALK_BOUND = math.log(5.0**2), math.log(30.0**2)
_SLACK, _STEEPEST, _SHORTEST_S = 0.5, 4.0, 0.02  # of a ramp: two bad readings are none
# information in a noise that comes with the reading, in a configured one, and in a configured walk
_STATED, _CONFIGURED, _UNREST = 250.0, 25.0, 4.0


class LearnedFactor:
    """A factor on a variance; its logarithm follows the likelihood's slope over the information so far."""

    def __init__(self, bound: float, information: float) -> None:
        self._bound, self._information, self._log = bound, information, 0.0

    @property
    def factor(self) -> float:
        """Present factor."""
        return math.exp(self._log)

    def learn(self, slope: float, information: float, forget: float) -> None:
        """Take the slope of the log-likelihood from one reading, and the information that it bears."""
        # at least that: a few readings must not overturn a level that has hardly shown for long
        self._information = max(_UNREST, self._information + information - forget * self._information)
        self._log = min(max(self._log + slope / self._information, -self._bound), self._bound)


def configured_walk() -> LearnedFactor:
    """The factor on a configured walk, to be learned."""
    return LearnedFactor(_WALK_BOUND, _UNREST)


class ReadingNoise:
    """The factor on the variance of a sensor's readings; corrects the walks that the sensor sees, too.

    The innovations are to be of unit variance, which sets the scale of noise and walks, and white, which sets their
    ratio: they correlate positively where the filter follows too slowly, negatively where it follows noise.
    `stated`: the noise comes with each reading.
    """

    def __init__(self, stated: bool) -> None:
        self._level = LearnedFactor(_READING_BOUND, _STATED if stated else _CONFIGURED)
        self._past = 0.0  # how the past innovations would have moved the state, of unit variance

    @property
    def factor(self) -> float:
        """Present factor."""
        return self._level.factor

    def learn(
        self, innovation: float, share: float, dt_s: float, walks: tuple[tuple[LearnedFactor, float], ...]
    ) -> None:
        """Take an innovation in standard deviations, and the share of its variance that is the state's.

        `walks`: what moves the state, and its part in that; none for a sensor that does not lead.
        """
        forget = min(1.0, dt_s / _MEMORY_S)
        innovation, known = min(max(innovation, -_LIMIT), _LIMIT), share / 8
        size, runs = (innovation**2 - 1) / 2, math.sqrt(known) * innovation * self._past
        by_noise = 1 - share / 2  # change of the innovations' variance with the noise, both as logarithms
        leads = bool(walks)
        self._level.learn(by_noise * size - leads * runs, by_noise**2 / 2 + leads * known, forget)
        for walk, part in walks:
            walk.learn(part * (share / 2 * size + runs), part**2 * (share**2 / 8 + known), forget)
        self._past = (1 - share) * self._past + math.sqrt(share * (2 - share)) * innovation


class Ramp:
    """Finds innovations that run away to one side: two cumulative sums (Page 1954)."""

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._sums, self._counts, self._began_s = [0.0, 0.0], [0, 0], [math.nan, math.nan]
        self._last_s = math.nan
        self.since_s = self.slope = math.nan  # of the last one: when it began, and its rise per second

    def update(self, innovation: float, taken_s: float) -> bool:
        """Take an innovation in standard deviations; returns whether a ramp is found."""
        found = False
        innovation = min(max(innovation, -_STEEPEST), _STEEPEST)
        for side, sign in enumerate((1.0, -1.0)):
            if self._sums[side] == 0.0:
                self._began_s[side], self._counts[side] = self._last_s, 0
            self._counts[side] += 1
            self._sums[side] = max(0.0, self._sums[side] + sign * innovation - _SLACK)
            if self._sums[side] > self._limit:
                mean = sign * (self._sums[side] / self._counts[side] + _SLACK)
                self.since_s = self._began_s[side]
                self.slope = 2 * mean / max(taken_s - self.since_s, _SHORTEST_S)
                found, self._sums[side] = math.isfinite(self.since_s), 0.0
        self._last_s = taken_s
        return found
