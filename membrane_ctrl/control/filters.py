"""Filters of single signals: first-order for unequal steps, drift; noise levels and ramps in
innovations. Pure.
"""

import math
from dataclasses import dataclass, field

from membrane_ctrl.model.state_tree import Count, StateNode


def smoothing(dt_s: float, time_constant_s: float) -> float:
    """Step fraction of a first-order lag, 1 - exp(-dt / T); 1 without a lag."""
    return -math.expm1(-dt_s / time_constant_s) if time_constant_s > 0 else 1.0


@dataclass(slots=True)
class LowPass(StateNode):
    """First-order lag that starts at its first input; a time constant of 0 passes the input
    through.
    """

    value: float = math.nan
    age_s: float = math.inf  # of a mean of all inputs; infinite without one

    @classmethod
    def with_early_mean(cls) -> "LowPass":
        """A lag that is the plain mean of its inputs at first, of which none weighs more than the
        others.
        """
        return cls(age_s=0.0)

    def reset(self, value: float) -> None:
        """Stand still at `value`; NaN: start at the next input."""
        self.value = value

    def update(self, given: float, dt_s: float, time_constant_s: float) -> float:
        """Output after `given` was applied for `dt_s`."""
        self.age_s += dt_s
        if math.isnan(self.value):
            self.value = given
        share = dt_s / self.age_s if dt_s > 0 else 0.0
        self.value += max(smoothing(dt_s, time_constant_s), share) * (given - self.value)
        return self.value


@dataclass(slots=True)
class LagRate(StateNode):
    """Rate of change of a signal behind a first-order lag, (x - lag(x)) / T, that survives the
    signal's absence.

    The mean rate over a step is the lag's change divided by the step, so that the rate integrates
    exactly to the lag's own movement; T = 0 gives the plain difference quotient. While the signal
    is absent (NaN) the last value stands and the rate decays; on its return the lag is placed so
    that the rate continues from its present value: neither makes a bump. A step of more than
    `step_max` counts as an absence.
    """

    rate_per_s: float = 0.0
    input: float = math.nan
    lag: float = math.nan
    absent: bool = True

    def update(
        self, given: float, dt_s: float, time_constant_s: float, step_max: float = math.inf
    ) -> float:
        """Mean rate per second over the step; `given` may be NaN."""
        share = smoothing(dt_s, time_constant_s)
        if math.isfinite(given):
            if self.absent or abs(given - self.input) > step_max:
                self.lag = given - self.rate_per_s * dt_s / share
            self.input = given
        self.absent = not math.isfinite(given)
        if math.isfinite(self.input):
            moved = share * (self.input - self.lag)
            self.lag += moved
            self.rate_per_s = moved / dt_s
        return self.rate_per_s


# Slope of a straight line through samples as they come.


@dataclass(slots=True)
class Slope(StateNode):
    """Least-squares slope of y over t, from running sums; times are counted from the first sample.

    With n evenly spread samples of noise sigma over a span T its standard deviation is sigma
    sqrt(12 / n) / T:
    0.25 µm/s for 1 µm, 50 Hz and 1.5 s.
    """

    start_s: float = math.nan
    count: Count = 0
    sum_t: float = 0.0
    sum_y: float = 0.0
    sum_tt: float = 0.0
    sum_ty: float = 0.0

    def add(self, time_s: float, value: float) -> None:
        """Add one sample, ignoring one that is not finite."""
        if not math.isfinite(value):
            return
        if self.count == 0:
            self.start_s = time_s
        t = time_s - self.start_s
        self.count += 1
        self.sum_t += t
        self.sum_y += value
        self.sum_tt += t * t
        self.sum_ty += t * value

    @property
    def per_s(self) -> float:
        """The slope, 0 until there are two different times."""
        spread = self.count * self.sum_tt - self.sum_t * self.sum_t
        return (self.count * self.sum_ty - self.sum_t * self.sum_y) / spread if spread > 0 else 0.0


# Tracker of a slow drift in noisy readings: value and rate, with fading memory.
#
# Least squares of a straight line through all readings, each weighted by exp(-age / T). For
# readings a step dt apart, with beta = exp(-dt / T) and r = reading - prediction (Morrison,
# Introduction to Sequential Smoothing and Prediction, 1969, degree-1 polynomial with fading
# memory):
#
#     value += (1 - beta^2) r,    rate += (1 - beta)^2 r / dt
#
# Both poles lie at beta: critically damped. A steady drift is tracked without error (a single lag
# would trail by rate x T). After a sudden onset of a drift v the tracker trails by v t exp(-t / T):
# at most v T / e. Noise of standard deviation sigma per reading becomes sigma sqrt(1.25 dt / T).


@dataclass(slots=True)
class DriftTracker(StateNode):
    """Value and rate of a drift that is initially 0; the memory T (`memory_s`) may change."""

    time_s: float = math.nan
    value_um: float = 0.0
    rate_um_per_s: float = 0.0

    def begin(self, time_s: float) -> None:
        """Set drift and rate to 0 at this time.

        An initially short memory would find an old drift sooner, but its noise would move a still
        mirror.
        """
        self.time_s = time_s
        self.value_um = 0.0
        self.rate_um_per_s = 0.0

    def at(self, time_s: float, memory_s: float) -> float:
        """Value in µm expected at a time (not before the last reading's); a rate is believed for
        one memory.
        """
        return self.value_um + self.rate_um_per_s * min(time_s - self.time_s, memory_s)

    def take(self, reading_um: float, time_s: float, memory_s: float) -> None:
        """Take a reading, later than the last one, into the memory."""
        dt_s = time_s - self.time_s
        beta = math.exp(-dt_s / memory_s)
        expected_um = self.at(time_s, memory_s)
        residual_um = reading_um - expected_um
        self.value_um = expected_um + (1.0 - beta**2) * residual_um
        self.rate_um_per_s += (1.0 - beta) ** 2 * residual_um / dt_s
        self.time_s = time_s


_MEMORY_S = 200.0
_LIMIT = 3.0  # an innovation beyond this many standard deviations counts as this many
# A factor's logarithm stays within these bounds
_READING_BOUND = math.log(5.0**2)
_WALK_BOUND = math.log(30.0**2)
# Of a ramp, in standard deviations: the drift that each cumulative sum tolerates, and the most that
# one innovation counts, so that two bad readings are no ramp
_SLACK = 0.5
_STEEPEST = 4.0
_SHORTEST_S = 0.02  # shortest duration of a ramp
# Information with which learning starts
_STATED_INFORMATION = 250.0  # a noise that comes with the reading
_CONFIGURED_INFORMATION = 25.0  # a configured noise of a reading
_WALK_INFORMATION = 4.0  # a configured walk


@dataclass(slots=True)
class LearnedFactor(StateNode):
    """A factor on a variance; its logarithm follows the likelihood's slope over the information so
    far.
    """

    information: float
    log: float = 0.0

    @property
    def factor(self) -> float:
        """Present factor."""
        return math.exp(self.log)

    def learn(self, slope: float, information: float, forget: float, bound: float) -> None:
        """Take the slope of the log-likelihood from one reading, and the information that it bears.

        The logarithm stays within +- `bound`.
        """
        # at least that: a few readings must not overturn a level that has hardly shown for long
        self.information = max(_WALK_INFORMATION, self.information + information - forget * self.information)
        self.log = min(max(self.log + slope / self.information, -bound), bound)


def configured_walk() -> LearnedFactor:
    """The factor on a configured walk, to be learned."""
    return LearnedFactor(_WALK_INFORMATION)


@dataclass(slots=True)
class ReadingNoise(StateNode):
    """The factor on the variance of a sensor's readings; corrects the walks that the sensor sees,
    too.

    The innovations are to be of unit variance, which sets the scale of noise and walks, and white,
    which sets their
    ratio: they correlate positively where the filter follows too slowly, negatively where it
    follows noise.
    """

    level: LearnedFactor
    past: float = 0.0  # how the past innovations would have moved the state, of unit variance

    @classmethod
    def of_reading(cls, stated: bool) -> "ReadingNoise":
        """The factor to be learned; `stated`: the noise comes with each reading."""
        return cls(LearnedFactor(_STATED_INFORMATION if stated else _CONFIGURED_INFORMATION))

    @property
    def factor(self) -> float:
        """Present factor."""
        return self.level.factor

    def learn(
        self,
        innovation: float,
        share: float,
        dt_s: float,
        walks: tuple[tuple[LearnedFactor, float], ...],
    ) -> None:
        """Take an innovation in standard deviations, and the share of its variance that is the
        state's.

        `walks`: what moves the state, and its part in that; none for a sensor that does not lead.
        """
        forget = min(1.0, dt_s / _MEMORY_S)
        innovation, known = min(max(innovation, -_LIMIT), _LIMIT), share / 8
        size, runs = (innovation**2 - 1) / 2, math.sqrt(known) * innovation * self.past
        by_noise = (
            1 - share / 2
        )  # change of the innovations' variance with the noise, both as logarithms
        leads = bool(walks)
        information = by_noise**2 / 2 + leads * known
        self.level.learn(by_noise * size - leads * runs, information, forget, _READING_BOUND)
        for walk, part in walks:
            slope = part * (share / 2 * size + runs)
            walk.learn(slope, part**2 * (share**2 / 8 + known), forget, _WALK_BOUND)
        self.past = (1 - share) * self.past + math.sqrt(share * (2 - share)) * innovation


@dataclass(slots=True)
class CumulativeSum(StateNode):
    """One side of a `Ramp`."""

    total: float = 0.0
    count: Count = 0
    began_s: float = math.nan


@dataclass(slots=True)
class Ramp(StateNode):
    """Finds innovations that run away to one side: two cumulative sums (Page 1954)."""

    up: CumulativeSum = field(default_factory=CumulativeSum)
    down: CumulativeSum = field(default_factory=CumulativeSum)
    last_s: float = math.nan
    since_s: float = math.nan  # when the last ramp began
    slope: float = math.nan  # of the last ramp: its rise per second

    def update(self, innovation: float, taken_s: float, limit: float) -> bool:
        """Take an innovation in standard deviations; returns whether a ramp is found."""
        found = False
        innovation = min(max(innovation, -_STEEPEST), _STEEPEST)
        for side, sign in ((self.up, 1.0), (self.down, -1.0)):
            if side.total == 0.0:
                side.began_s = self.last_s
                side.count = 0
            side.count += 1
            side.total = max(0.0, side.total + sign * innovation - _SLACK)
            if side.total > limit:
                mean = sign * (side.total / side.count + _SLACK)
                self.since_s = side.began_s
                self.slope = 2 * mean / max(taken_s - self.since_s, _SHORTEST_S)
                found = math.isfinite(self.since_s)
                side.total = 0.0
        self.last_s = taken_s
        return found
