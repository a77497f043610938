"""Experiments as step machines: one reading in, one flow out, no clock and no I/O.

The caller runs `step` once per tick and returns the mirror to the loop on `Finished`. Every machine runs inside an
`ExcursionGuard`, which ends it before the mirror exceeds its permitted excursion from where it
stood.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from membrane_ctrl.control import gas
from membrane_ctrl.control.filters import LowPass

# An experiment's view of a tick.


@dataclass(frozen=True, slots=True)
class BenchSample:
    """One sample of the bench; NaN for missing and lost values."""

    displacement_um: float
    ambient_pressure_pa: float = float("nan")
    air_temperature_c: float = float("nan")


FAST_S, SLOW_S = 0.1, 0.4  # of the two filters whose difference is the speed, for a reading with little noise
STOPPED = "stopped at"  # begins the reason of an experiment that the guard ended
_LOST_MAX_S = 0.3  # as long as the safety table tolerates a stale reading


@dataclass(frozen=True, slots=True)
class Finished:
    """The end of an experiment: completed, or the reason and a remedy."""

    completed: bool
    reason: str


@dataclass(frozen=True, slots=True)
class Around:
    """The operating point of an experiment."""

    holding_flow_um_per_s: float  # mean flow of the loop before it
    least_flow_um_per_s: float  # of the pump while it runs
    full_flow_um_per_s: float
    laser_um: float  # standard deviation of a reading
    limit_um: float = 10.0  # largest excursion of the centre from where it stood
    stretch: float = 1.0  # of the filters, for a noisy laser with few readings (`quiet_stretch`)

    def within(self, flow_um_per_s: float) -> float:
        """The nearest flow of a running pump."""
        return min(max(flow_um_per_s, self.least_flow_um_per_s), self.full_flow_um_per_s)


class Experiment(Protocol):
    """A step machine."""

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """Flow in um/s until the next reading, or the end."""


# A moving mirror continues for the pump's delay (0.24 s, up to twice that on a slow bench) after the flow is reduced
_DELAY_S = 0.4


class CentreMotion:
    """Position and speed of the centre from noisy readings: two lags, and their difference over their times'."""

    def __init__(self, stretch: float = 1.0) -> None:
        self._fast_s, self._slow_s = stretch * FAST_S, stretch * SLOW_S
        self._fast, self._slow = LowPass(self._fast_s), LowPass(self._slow_s)
        self.coast_s = _DELAY_S + self._fast_s  # from a reading to its effect: the filter is late as well
        self.lost_s = 0.0

    def update(self, displacement_um: float, dt_s: float) -> None:
        """Take a reading; count a lost one, changing nothing else."""
        if not math.isfinite(displacement_um):
            self.lost_s += dt_s
            return
        self.lost_s = 0.0
        self._fast.update(displacement_um, dt_s)
        self._slow.update(displacement_um, dt_s)

    @property
    def position_um(self) -> float:
        """Filtered reading, as late as the faster filter."""
        return self._fast.value

    @property
    def speed_um_per_s(self) -> float:
        """Filtered speed."""
        return (self._fast.value - self._slow.value) / (self._slow_s - self._fast_s)

    def noise_per_laser_um(self, rate_hz: float) -> float:
        """Standard deviation of position + `coast_s` x speed for readings of 1 um.

        It is sigma sqrt(dt / (2 T)) behind a lag.
        """
        gain = self.coast_s / (self._slow_s - self._fast_s)
        fast = (1 + gain) ** 2 / (2 * self._fast_s * rate_hz)
        slow = gain**2 / (2 * self._slow_s * rate_hz)
        both = 2 * gain * (1 + gain) / ((self._fast_s + self._slow_s) * rate_hz)
        return math.sqrt(fast + slow - both)


_IN_HAND_SIGMAS = 3.0
# Of the limit, for the noise: with more, the noise stops sound experiments; longer filters see motion later
_IN_HAND_SHARE = 0.22
_STRETCHES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)


def quiet_stretch(laser_um: float, limit_um: float, rate_hz: float) -> float:
    """Filters of this many times their length leave the noise its share of the limit; the longest if none does."""
    share_um = _IN_HAND_SHARE * limit_um / _IN_HAND_SIGMAS
    quiet = (s for s in _STRETCHES if laser_um * CentreMotion(s).noise_per_laser_um(rate_hz) <= share_um)
    return next(quiet, _STRETCHES[-1])


class ExcursionGuard:
    """Lets an experiment run while the centre can still be stopped within the limit.

    The centre is judged where it will come to rest, position + speed x time to react, with a margin of three standard
    deviations of that figure's own noise, which grows with fewer readings per second. Raises ValueError, with a
    remedy, if the margin uses up the limit.
    """

    def __init__(self, experiment: Experiment, around: Around, centre_um: float, rate_hz: float) -> None:
        self._experiment = experiment
        self._motion = CentreMotion(around.stretch)
        self._centre_um = centre_um
        in_hand_um = _IN_HAND_SIGMAS * self._motion.noise_per_laser_um(rate_hz) * around.laser_um
        if in_hand_um >= around.limit_um:
            raise ValueError(
                f"limit of {around.limit_um:g} um: the laser's noise alone takes {in_hand_um:.1f} um of it at "
                f"{rate_hz:g} readings/s; give a larger limit, or a faster or quieter laser"
            )
        self._bound_um = around.limit_um - in_hand_um
        self._limit_um = around.limit_um

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """The experiment's step, or the end of it."""
        self._motion.update(measurement.displacement_um, dt_s)
        if self._motion.lost_s > _LOST_MAX_S:
            return Finished(False, f"the laser reading was lost for {_LOST_MAX_S:g} s: check the laser, then repeat")
        off_um = self._motion.position_um - self._centre_um
        coming_um = off_um + self._motion.coast_s * self._motion.speed_um_per_s
        if max(abs(off_um), abs(coming_um)) > self._bound_um:
            return Finished(
                False,
                f"{STOPPED} {off_um:+.1f} um, moving at {self._motion.speed_um_per_s:+.1f} um/s: the limit of "
                f"{self._limit_um:g} um was near; something else moved the mirror, or the pump is much stronger "
                "than configured",
            )
        return self._experiment.step(measurement, dt_s)


class Patterned:
    """A flow that follows a pattern (s to um/s) about the holding flow, with a weak pull back to where it began.

    The pull is needed because the holding flow is never known exactly and the mirror integrates the difference; it is
    too slow to disturb the pattern, and harmless to the identification, which knows the flow.
    """

    PULL_PER_S = 0.15

    def __init__(
        self, around: Around, pattern: Callable[[float], float], duration_s: float, centre_um: float
    ) -> None:
        self._around = around
        self._pattern = pattern
        self._duration_s = duration_s
        self._centre_um = centre_um
        self._motion = CentreMotion(around.stretch)
        self._time_s = 0.0

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """One tick of the pattern."""
        if self._time_s >= self._duration_s:
            return Finished(True, "done")
        self._motion.update(measurement.displacement_um, dt_s)
        back_um_per_s = self.PULL_PER_S * (self._centre_um - self._motion.position_um)
        pattern_um_per_s = self._pattern(self._time_s)
        self._time_s += dt_s
        return self._around.within(self._around.holding_flow_um_per_s + pattern_um_per_s + back_um_per_s)


# Flows in time for `Patterned`, sized so that the mirror stays within a few um. Each takes the identified gain: the
# same excursion on a strong and a weak pump.

Pattern = Callable[[float], float]

_SHARE = 0.25  # of the excursion limit: the weather, the pull and the laser's noise need the rest


def steps(around: Around, gain: float, hold_s: float = 2.0) -> Pattern:
    """Up, back, down, back, each for `hold_s`: easy to judge by eye."""
    up, down = room(around)
    size = min(up, down, _SHARE * around.limit_um / (gain * hold_s))
    levels = (size, 0.0, -size, 0.0)
    return lambda time_s: levels[int(time_s / hold_s) % 4]


def doublets(around: Around, gain: float, pulse_s: float = 0.3) -> Pattern:
    """Short pulses up, each followed by an equal one down: many steep edges, which separate dead time from lag.

    The downward flow is limited by the leak, so it takes longer; the mean flow is the holding flow.
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
            f"no room around the holding flow of {around.holding_flow_um_per_s:.2f} um/s in the pump's range of "
            f"{around.least_flow_um_per_s:.2f} .. {around.full_flow_um_per_s:.2f} um/s: "
            + (bleed_open(around.holding_flow_um_per_s, around.least_flow_um_per_s) if down <= 0 else "find the leak")
        )
    return up, down


def bleed_open(loss_um_per_s: float, least_um_per_s: float = 0.0) -> str:
    """What to do where a mirror loses too little gas for the least flow of its pump."""
    more_um_per_s = max(0.3, 1.5 * least_um_per_s - loss_um_per_s)
    share = more_um_per_s / gas.VENT_FULL_UM_PER_S
    return f"open the bleed by {more_um_per_s:.1f} um/s (loop.bleed_fraction larger by {share:.3f})"


# Bounded asymmetric relay about the holding flow.
#
# Asymmetric, because the way down is no faster than the leak and the pump must not stall (its least flow is the lower
# end), while the way up has most of the pump. The amplitude starts small and grows while the mirror overshoots its
# threshold by little, so that a pump three times stronger or slower than configured stays within the same bounds.

THRESHOLD_SHARE = 0.25  # of the excursion limit
OVERSHOOT_SHARE = 0.2
_GROWTH = 1.6
_FIRST_MAX_UM_PER_S = 1.5
_OVERSHOOT_LEAST_UM = 0.2  # smaller ones are noise
# A half cycle of 5 um takes this long if leak + bleed are 0.06 um/s, where no mirror can be held.
_PATIENCE_S = 90.0
NO_ANSWER = "the mirror did not"  # begins the reason of a relay that waited in vain


class Relay:
    """Switches between a high and a low flow whenever the centre leaves a band about `centre_um`."""

    def __init__(self, around: Around, centre_um: float, duration_s: float = 120.0) -> None:
        self._around = around
        self._centre_um = centre_um
        self._duration_s = duration_s
        self._threshold_um = THRESHOLD_SHARE * around.limit_um
        self._motion = CentreMotion(around.stretch)
        first = min(around.holding_flow_um_per_s, _FIRST_MAX_UM_PER_S)
        self._amplitudes_um_per_s = {1: first, -1: first}
        self._speeds_um_per_s = {1: first, -1: first}
        self._direction = 1
        self._time_s = self._since_switch_s = 0.0
        self._overshoot_um = 0.0
        self._at_centre_s = math.nan
        self.crossings = 0

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """One tick of the relay."""
        self._motion.update(measurement.displacement_um, dt_s)
        if self._time_s >= self._duration_s:
            return Finished(True, f"{self.crossings} crossings")
        self._time_s += dt_s
        self._since_switch_s += dt_s
        off_um = self._motion.position_um - self._centre_um
        # beyond the threshold on the side it came from, for the delay after a switch
        self._overshoot_um = max(self._overshoot_um, -self._direction * off_um - self._threshold_um)
        if math.isnan(self._at_centre_s) and self._direction * off_um > 0:
            self._at_centre_s = self._time_s
        if self._direction * off_um > self._threshold_um:
            self._switch()
        elif self._since_switch_s > _PATIENCE_S:
            way = "rise" if self._direction > 0 else "sink"
            around = self._around
            open_bleed = bleed_open(around.holding_flow_um_per_s, around.least_flow_um_per_s)
            remedy = "check the pump, its tube and the leak" if self._direction > 0 else open_bleed
            return Finished(False, f"{NO_ANSWER} {way} by {self._threshold_um:g} um in {_PATIENCE_S:g} s: {remedy}")
        around = self._around
        swing = self._direction * self._amplitudes_um_per_s[self._direction]
        return around.within(around.holding_flow_um_per_s + swing)

    def _switch(self) -> None:
        """Reverse; adapt the flow of the previous half cycle, whose overshoot is now known."""
        wanted_um = OVERSHOOT_SHARE * self._around.limit_um
        # the guard stops anything that would coast further, however short the true delay
        fastest_um_per_s = wanted_um / self._motion.coast_s
        if self._time_s > self._at_centre_s:
            self._speeds_um_per_s[self._direction] = self._threshold_um / (self._time_s - self._at_centre_s)
        if self.crossings > 0:
            before = -self._direction
            factor = min(
                wanted_um / max(self._overshoot_um, _OVERSHOOT_LEAST_UM),
                fastest_um_per_s / self._speeds_um_per_s[before],
            )
            self._amplitudes_um_per_s[before] *= min(max(factor, 1 / _GROWTH), _GROWTH)
        self._direction = -self._direction
        self._overshoot_um = 0.0
        self._since_switch_s = 0.0
        self._at_centre_s = math.nan
        self.crossings += 1
