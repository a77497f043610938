"""Experiments as step machines: one reading in, one flow out, no clock and no I/O.

Whoever runs them calls `step` once a tick and hands the mirror back to the loop when it says `Finished`. Every
machine is run inside an `ExcursionGuard`, which ends it before the mirror is further from where it stood than it
may go.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from membrane_ctrl.control.filters import LowPass

# What an experiment sees of a tick.


@dataclass(frozen=True, slots=True)
class BenchSample:
    """One sample of the bench; NaN for what the bench does not have or has lost."""

    displacement_um: float
    ambient_pressure_pa: float = float("nan")
    air_temperature_c: float = float("nan")


FAST_S, SLOW_S = 0.1, 0.4  # of the two filters whose difference is the speed
_LOST_MAX_S = 0.3  # as long as the safety table bears a stale reading


@dataclass(frozen=True, slots=True)
class Finished:
    """The end of an experiment: done, or why not and what would help."""

    completed: bool
    reason: str


@dataclass(frozen=True, slots=True)
class Around:
    """What an experiment is made about."""

    holding_flow_um_per_s: float  # mean flow of the loop before it
    least_flow_um_per_s: float  # of the pump while it runs
    full_flow_um_per_s: float
    laser_um: float  # standard deviation of a reading
    limit_um: float = 10.0  # furthest the centre may go from where it stood

    def within(self, flow_um_per_s: float) -> float:
        """The nearest flow of a running pump."""
        return min(max(flow_um_per_s, self.least_flow_um_per_s), self.full_flow_um_per_s)


class Experiment(Protocol):
    """A step machine."""

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """Flow in um/s to put out until the next reading, or the end."""


class CentreMotion:
    """Position and speed of the centre from noisy readings: two lags, and their difference over their times'."""

    def __init__(self) -> None:
        self._fast, self._slow = LowPass(FAST_S), LowPass(SLOW_S)
        self.lost_s = 0.0

    def update(self, displacement_um: float, dt_s: float) -> None:
        """Take a reading; a lost one is counted and leaves the rest."""
        if not math.isfinite(displacement_um):
            self.lost_s += dt_s
            return
        self.lost_s = 0.0
        self._fast.update(displacement_um, dt_s)
        self._slow.update(displacement_um, dt_s)

    @property
    def position_um(self) -> float:
        """Filtered reading, `FAST_S` late."""
        return self._fast.value

    @property
    def speed_um_per_s(self) -> float:
        """Filtered speed."""
        return (self._fast.value - self._slow.value) / (SLOW_S - FAST_S)


# A mirror that moves goes on moving for the pump's delay (0.24 s, up to twice that on a slow bench) after the flow
# is taken back, and the filter is 0.1 s late.
COAST_S = 0.5


class ExcursionGuard:
    """Lets an experiment run while the centre can still be stopped within the limit.

    The centre is judged where it will have come to rest, position + speed x `COAST_S`, with three standard deviations
    of that figure's own noise in hand. Raises ValueError if the noise kept in hand leaves nothing of the limit; the
    message says what would help.

    Parameters
    ----------
    centre_um : float
        Where the mirror stood before.
    rate_hz : float
        Readings in a second: with fewer, the figure is noisier and more is kept in hand.
    """

    def __init__(self, experiment: Experiment, around: Around, centre_um: float, rate_hz: float) -> None:
        self._experiment = experiment
        self._motion = CentreMotion()
        self._centre_um = centre_um
        in_hand_um = 3 * self._noise_per_laser_um(rate_hz) * around.laser_um
        if in_hand_um >= around.limit_um:
            raise ValueError(
                f"limit of {around.limit_um:g} um: the laser's noise alone takes {in_hand_um:.1f} um of it at "
                f"{rate_hz:g} readings/s; give a larger limit, or a faster or quieter laser"
            )
        self._bound_um = around.limit_um - in_hand_um
        self._limit_um = around.limit_um

    @staticmethod
    def _noise_per_laser_um(rate_hz: float) -> float:
        """Standard deviation of position + coast x speed for readings of 1 um; sigma sqrt(dt / (2 T)) behind a
        lag."""
        gain = COAST_S / (SLOW_S - FAST_S)
        fast = (1 + gain) ** 2 / (2 * FAST_S * rate_hz)
        slow = gain**2 / (2 * SLOW_S * rate_hz)
        both = 2 * gain * (1 + gain) / ((FAST_S + SLOW_S) * rate_hz)
        return math.sqrt(fast + slow - both)

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """The experiment's step, or the end of it."""
        self._motion.update(measurement.displacement_um, dt_s)
        if self._motion.lost_s > _LOST_MAX_S:
            return Finished(False, f"the laser reading was lost for {_LOST_MAX_S:g} s: check the laser, then repeat")
        off_um = self._motion.position_um - self._centre_um
        coming_um = off_um + COAST_S * self._motion.speed_um_per_s
        if max(abs(off_um), abs(coming_um)) > self._bound_um:
            return Finished(
                False,
                f"stopped at {off_um:+.1f} um, moving at {self._motion.speed_um_per_s:+.1f} um/s: the limit of "
                f"{self._limit_um:g} um was near; something else moved the mirror, or the pump is much stronger "
                "than configured",
            )
        return self._experiment.step(measurement, dt_s)


class Patterned:
    """A flow that follows a pattern in time about the holding flow, with a weak pull back to where it began.

    The pull is there because the holding flow is never quite known and the mirror integrates the difference; it is
    slow enough to leave the pattern alone, and harmless to the identification, which knows the flow.

    Parameters
    ----------
    pattern : callable
        Time in s to flow in um/s about the holding flow.
    """

    PULL_PER_S = 0.15

    def __init__(
        self, around: Around, pattern: Callable[[float], float], duration_s: float, centre_um: float
    ) -> None:
        self._around = around
        self._pattern = pattern
        self._duration_s = duration_s
        self._centre_um = centre_um
        self._motion = CentreMotion()
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
