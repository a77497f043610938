"""Experiments as step machines: one reading in, one flow out, no clock and no I/O.

The caller runs `step` once per tick and returns the mirror to the loop on `Finished`. Every machine
runs inside an `ExcursionGuard`, which ends it before the mirror exceeds its permitted excursion
from where it stood.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import product
from typing import Protocol

from membrane_ctrl.control import gas
from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.model.state_tree import Count, StateNode


@dataclass(frozen=True, slots=True)
class BenchSample:
    """One sample of the bench; NaN for missing and lost values."""

    displacement_um: float
    ambient_pressure_pa: float = float("nan")
    air_temperature_c: float = float("nan")


# Time constants of the two filters whose difference is the speed, for a reading with little noise
FAST_S = 0.1
SLOW_S = 0.4
# A moving mirror continues for the pump's delay and lag after the flow is reduced: 0.24 s, up to
# twice that on a slow bench, unless more is known
_LATE_S = 0.4
_LATE_MOST_S = 1.0  # pulses turn within this time
_LOST_MAX_S = 0.3  # as long as the safety table tolerates a stale reading


class ExperimentEnd(StrEnum):
    """How an experiment ended."""

    COMPLETED = "completed"
    STOPPED_BY_GUARD = "stopped_by_guard"  # the mirror moved too far
    NO_RESPONSE = "no_response"  # the mirror did not move
    READING_LOST = "reading_lost"
    OVERDUE = "overdue"
    INTERRUPTED = "interrupted"  # by a person, the safety table or another state


@dataclass(frozen=True, slots=True)
class Finished(StateNode):
    """The end of an experiment, with a reason and a remedy for people."""

    end: ExperimentEnd
    reason: str

    @property
    def completed(self) -> bool:
        """Whether it ran as long as it was meant to."""
        return self.end is ExperimentEnd.COMPLETED


@dataclass(frozen=True, slots=True)
class Around(StateNode):
    """The operating point of an experiment."""

    holding_flow_um_per_s: float  # mean flow of the loop before it
    least_flow_um_per_s: float  # of the pump while it runs
    full_flow_um_per_s: float
    laser_um: float  # standard deviation of a reading
    limit_um: float = 10.0  # largest excursion of the centre from where it stood
    late_s: float = _LATE_S  # delay and lag of the pump, if known
    stretch: float = 1.0  # of the filters, for a noisy laser with few readings (`quieted`)

    def within(self, flow_um_per_s: float) -> float:
        """The nearest flow of a running pump."""
        return min(max(flow_um_per_s, self.least_flow_um_per_s), self.full_flow_um_per_s)


class Experiment(Protocol):
    """A step machine."""

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """Flow in µm/s until the next reading, or the end."""


@dataclass(slots=True)
class MotionState(StateNode):
    """The two lags, and for how long the reading has been lost."""

    fast: LowPass = field(default_factory=LowPass)
    slow: LowPass = field(default_factory=LowPass)
    lost_s: float = 0.0


class CentreMotion:
    """Position and speed of the centre from noisy readings: two lags, and their difference over
    their times'.
    """

    def __init__(
        self, stretch: float = 1.0, late_s: float = _LATE_S, memory: MotionState | None = None
    ) -> None:
        self.memory = memory or MotionState()
        self._fast_s, self._slow_s = stretch * FAST_S, stretch * SLOW_S
        # from a reading to its effect: the filter is late as well
        self.coast_s = min(max(late_s, _LATE_S), _LATE_MOST_S) + self._fast_s

    def update(self, displacement_um: float, dt_s: float) -> None:
        """Take a reading; count a lost one, changing nothing else."""
        memory = self.memory
        if not math.isfinite(displacement_um):
            memory.lost_s += dt_s
            return
        memory.lost_s = 0.0
        memory.fast.update(displacement_um, dt_s, self._fast_s)
        memory.slow.update(displacement_um, dt_s, self._slow_s)

    @property
    def lost_s(self) -> float:
        """For how long the reading has been lost."""
        return self.memory.lost_s

    @property
    def position_um(self) -> float:
        """Filtered reading, as late as the faster filter."""
        return self.memory.fast.value

    @property
    def speed_um_per_s(self) -> float:
        """Filtered speed."""
        return (self.memory.fast.value - self.memory.slow.value) / (self._slow_s - self._fast_s)

    def noise_per_laser_um(self, rate_hz: float) -> float:
        """Standard deviation of position + `coast_s` x speed for readings of 1 µm.

        It is sigma sqrt(dt / (2 T)) behind a lag.
        """
        gain = self.coast_s / (self._slow_s - self._fast_s)
        fast = (1 + gain) ** 2 / (2 * self._fast_s * rate_hz)
        slow = gain**2 / (2 * self._slow_s * rate_hz)
        both = 2 * gain * (1 + gain) / ((self._fast_s + self._slow_s) * rate_hz)
        return math.sqrt(fast + slow - both)


_IN_HAND_SIGMAS = 3.0
# Of the limit, for the noise: with more, the noise stops sound experiments; longer filters see
# motion later
_IN_HAND_SHARE = 0.22
_STRETCHES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)


def quieted(around: Around, rate_hz: float) -> Around:
    """With filters that leave the noise its share of the limit; if none does, the longest for the
    usual delay.
    """
    share_um = _IN_HAND_SHARE * around.limit_um / _IN_HAND_SIGMAS
    for late_s, stretch in product((around.late_s, _LATE_S), _STRETCHES):
        if around.laser_um * CentreMotion(stretch, late_s).noise_per_laser_um(rate_hz) <= share_um:
            break
    return replace(around, late_s=late_s, stretch=stretch)


_PULL_PER_S = 0.15  # stable on a pump three times as strong as configured, and 2 s late
_BACK_SHARE = 0.2  # of the limit, within which the loop takes over
_BACK_MOST_S = 40.0  # with a wrong holding flow the pull ends further off
# limits: this far off something else moves the mirror, and the loop's safety rules are needed
_STRAYED = 2.0


@dataclass(slots=True)
class GuardState(StateNode):
    """The motion that the guard sees, and how the experiment has ended."""

    motion: MotionState = field(default_factory=MotionState)
    ended: Finished | None = None
    back_s: float = 0.0  # on the way back


class ExcursionGuard:
    """Lets an experiment run while the centre can still be stopped within the limit, then brings it
    back.

    The centre is judged where it will come to rest, position + speed x time to react, with a margin
    of three standard deviations of that figure's own noise, which grows with fewer readings per
    second. Raises ValueError, with a remedy, if the margin uses up the limit.

    Back it goes on the holding flow with a weak pull: behind a curve other than the configured one,
    an integrator would wind up on the way and carry the mirror further past the centre than the
    experiment may. A mirror that strays all the same, behind an open vent or a dead pump, is given
    to the loop at twice the limit. An experiment that sets raw commands (`raw`) ends where it is.
    """

    def __init__(
        self,
        experiment: Experiment,
        around: Around,
        centre_um: float,
        rate_hz: float,
        raw: bool = False,
        memory: GuardState | None = None,
    ) -> None:
        self.memory = memory or GuardState()
        self._experiment = experiment
        self._around, self._raw = around, raw
        self._motion = CentreMotion(around.stretch, around.late_s, self.memory.motion)
        self._centre_um = centre_um
        in_hand_um = _IN_HAND_SIGMAS * self._motion.noise_per_laser_um(rate_hz) * around.laser_um
        if in_hand_um >= around.limit_um:
            raise ValueError(
                f"limit of {around.limit_um:g} µm: the laser's noise alone takes "
                f"{in_hand_um:.1f} µm of it at "
                f"{rate_hz:g} readings/s; give a larger limit, or a faster or quieter laser"
            )
        self._bound_um = around.limit_um - in_hand_um
        self._limit_um = around.limit_um

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """The experiment's step, then the way back, then the experiment's end."""
        self._motion.update(measurement.displacement_um, dt_s)
        if self._motion.lost_s > _LOST_MAX_S:
            lost = (
                f"the reading was lost for {_LOST_MAX_S:g} s: check the laser (without one, the "
                "camera), then repeat"
            )
            return self.memory.ended or Finished(ExperimentEnd.READING_LOST, lost)
        off_um = self._motion.position_um - self._centre_um
        if self.memory.ended is None:
            found = self._guarded(off_um, measurement, dt_s)
            if self._raw or not isinstance(found, Finished):
                return found
            self.memory.ended = found
        self.memory.back_s += dt_s
        back = abs(off_um) < _BACK_SHARE * self._limit_um
        if back or self.memory.back_s > _BACK_MOST_S or abs(off_um) > _STRAYED * self._limit_um:
            return self.memory.ended
        back_um_per_s = self._around.holding_flow_um_per_s - _PULL_PER_S * off_um
        return min(max(back_um_per_s, 0.0), self._around.full_flow_um_per_s)

    def _guarded(self, off_um: float, measurement: BenchSample, dt_s: float) -> float | Finished:
        coming_um = off_um + self._motion.coast_s * self._motion.speed_um_per_s
        if max(abs(off_um), abs(coming_um)) > self._bound_um:
            return Finished(
                ExperimentEnd.STOPPED_BY_GUARD,
                f"stopped at {off_um:+.1f} µm, moving at {self._motion.speed_um_per_s:+.1f} "
                "µm/s: the limit of "
                f"{self._limit_um:g} µm was near; something else moved the mirror, or the "
                "pump is much stronger "
                "than configured",
            )
        return self._experiment.step(measurement, dt_s)


@dataclass(slots=True)
class PatternState(StateNode):
    """Where a pattern is."""

    motion: MotionState = field(default_factory=MotionState)
    time_s: float = 0.0


class Patterned:
    """A flow that follows a pattern (s to µm/s) about the holding flow, with a weak pull back to
    where it began.

    The pull is needed because the holding flow is never known exactly and the mirror integrates the
    difference; it is too slow to disturb the pattern, and harmless to the identification, which
    knows the flow.
    """

    def __init__(
        self,
        around: Around,
        pattern: Callable[[float], float],
        duration_s: float,
        centre_um: float,
        memory: PatternState | None = None,
    ) -> None:
        self.memory = memory or PatternState()
        self._around = around
        self._pattern = pattern
        self._duration_s = duration_s
        self._centre_um = centre_um
        self._motion = CentreMotion(around.stretch, around.late_s, self.memory.motion)

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """One tick of the pattern."""
        memory = self.memory
        if memory.time_s >= self._duration_s:
            return Finished(ExperimentEnd.COMPLETED, "done")
        self._motion.update(measurement.displacement_um, dt_s)
        back_um_per_s = _PULL_PER_S * (self._centre_um - self._motion.position_um)
        pattern_um_per_s = self._pattern(memory.time_s)
        memory.time_s += dt_s
        return self._around.within(
            self._around.holding_flow_um_per_s + pattern_um_per_s + back_um_per_s
        )


def room(around: Around) -> tuple[float, float]:
    """Flow above and below the holding flow. Raises ValueError without any: the mirror is too tight
    or too leaky.
    """
    up = around.full_flow_um_per_s - around.holding_flow_um_per_s
    down = around.holding_flow_um_per_s - around.least_flow_um_per_s
    if min(up, down) <= 0:
        raise ValueError(
            f"no room around the holding flow of {around.holding_flow_um_per_s:.2f} µm/s in "
            "the pump's range of "
            f"{around.least_flow_um_per_s:.2f} .. {around.full_flow_um_per_s:.2f} µm/s: "
            + (
                bleed_open(around.holding_flow_um_per_s, around.least_flow_um_per_s)
                if down <= 0
                else "find the leak"
            )
        )
    return up, down


def bleed_open(loss_um_per_s: float, least_um_per_s: float = 0.0) -> str:
    """What to do where a mirror loses too little gas for the least flow of its pump."""
    more_um_per_s = max(0.3, 1.5 * least_um_per_s - loss_um_per_s)
    share = more_um_per_s / gas.VENT_FULL_UM_PER_S
    return f"open the bleed by {more_um_per_s:.1f} µm/s (loop.bleed_fraction larger by {share:.3f})"


# Bounded asymmetric relay about the holding flow.
#
# Asymmetric, because the way down is no faster than the leak and the pump must not stall (its least
# flow is the lower end), while the way up has most of the pump. The amplitude starts small and
# grows while the mirror overshoots its threshold by little, so that a pump three times stronger or
# slower than configured
# stays within
# the same bounds.

THRESHOLD_SHARE = 0.25  # of the excursion limit
OVERSHOOT_SHARE = 0.2
_GROWTH = 1.6
_FIRST_MAX_UM_PER_S = 1.5
_OVERSHOOT_LEAST_UM = 0.2  # smaller ones are noise
# A half cycle of 5 µm takes this long if leak + bleed are 0.06 µm/s, where no mirror can be held.
_PATIENCE_S = 90.0


@dataclass(slots=True)
class HalfCycle(StateNode):
    """What a relay has found in one direction."""

    amplitude_um_per_s: float
    speed_um_per_s: float


@dataclass(slots=True)
class RelayState(StateNode):
    """Where a relay is, and the amplitudes that it has found."""

    up: HalfCycle
    down: HalfCycle
    motion: MotionState = field(default_factory=MotionState)
    rises: bool = True
    time_s: float = 0.0
    since_switch_s: float = 0.0
    overshoot_um: float = 0.0
    at_centre_s: float = math.nan
    crossings: Count = 0

    @property
    def direction(self) -> int:
        """1 upwards, -1 downwards."""
        return 1 if self.rises else -1


def begin_relay(around: Around) -> RelayState:
    """The state of a relay that begins."""
    first = min(around.holding_flow_um_per_s, _FIRST_MAX_UM_PER_S)
    return RelayState(HalfCycle(first, first), HalfCycle(first, first))


class Relay:
    """Switches between a high and a low flow whenever the centre
    leaves a band about `centre_um`.
    """

    def __init__(
        self,
        around: Around,
        centre_um: float,
        duration_s: float = 120.0,
        memory: RelayState | None = None,
    ) -> None:
        self.memory = memory or begin_relay(around)
        self._around = around
        self._centre_um = centre_um
        self._duration_s = duration_s
        self._threshold_um = THRESHOLD_SHARE * around.limit_um
        self._motion = CentreMotion(around.stretch, around.late_s, self.memory.motion)

    @property
    def crossings(self) -> int:
        """How often it has switched."""
        return self.memory.crossings

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """One tick of the relay."""
        memory = self.memory
        self._motion.update(measurement.displacement_um, dt_s)
        if memory.time_s >= self._duration_s:
            return Finished(ExperimentEnd.COMPLETED, f"{memory.crossings} crossings")
        memory.time_s += dt_s
        memory.since_switch_s += dt_s
        off_um = self._motion.position_um - self._centre_um
        # beyond the threshold on the side it came from, for the delay after a switch
        memory.overshoot_um = max(
            memory.overshoot_um, -memory.direction * off_um - self._threshold_um
        )
        if math.isnan(memory.at_centre_s) and memory.direction * off_um > 0:
            memory.at_centre_s = memory.time_s
        around = self._around
        if memory.direction * off_um > self._threshold_um:
            self._switch()
        elif memory.since_switch_s > _PATIENCE_S:
            way = "rise" if memory.rises else "sink"
            open_bleed = bleed_open(around.holding_flow_um_per_s, around.least_flow_um_per_s)
            remedy = "check the pump, its tube and the leak" if memory.rises else open_bleed
            still = (
                f"the mirror did not {way} by {self._threshold_um:g} µm in {_PATIENCE_S:g} s: "
                f"{remedy}"
            )
            return Finished(ExperimentEnd.NO_RESPONSE, still)
        half = memory.up if memory.rises else memory.down
        return around.within(
            around.holding_flow_um_per_s + memory.direction * half.amplitude_um_per_s
        )

    def _switch(self) -> None:
        """Reverse; adapt the flow of the previous half cycle, whose overshoot is now known."""
        memory = self.memory
        half, before = (memory.up, memory.down) if memory.rises else (memory.down, memory.up)
        wanted_um = OVERSHOOT_SHARE * self._around.limit_um
        # the guard stops anything that would coast further, however short the true delay
        fastest_um_per_s = wanted_um / self._motion.coast_s
        if memory.time_s > memory.at_centre_s:
            half.speed_um_per_s = self._threshold_um / (memory.time_s - memory.at_centre_s)
        if memory.crossings > 0:
            by_overshoot = wanted_um / max(memory.overshoot_um, _OVERSHOOT_LEAST_UM)
            factor = min(by_overshoot, fastest_um_per_s / before.speed_um_per_s)
            before.amplitude_um_per_s *= min(max(factor, 1 / _GROWTH), _GROWTH)
        memory.rises = not memory.rises
        memory.overshoot_um = 0.0
        memory.since_switch_s = 0.0
        memory.at_centre_s = math.nan
        memory.crossings += 1
