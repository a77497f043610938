"""Events that happen to the simulated bench at a time, and change its surroundings."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

Series = FloatArray
_DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Surroundings:
    """The bench's surroundings in each step of a block; arrays (steps,), filled in place."""

    time_s: Series  # plant time of each step
    ambient_pa: Series
    air_k: Series
    leak_factor: Series  # leak over its configured value
    laser_bias_um: Series  # displacement of the laser's mount
    laser_lost: Series  # 1 where the laser gets no light back, else 0


class BenchEvent(Protocol):
    """Something that happens to the bench at a time; picklable."""

    def apply(self, on: Surroundings) -> None:
        """Add the event's effect to the surroundings."""


@dataclass(frozen=True, slots=True)
class AmbientChange:
    """Air pressure changes: a door (20 Pa at once), weather (100 Pa over 600 s)."""

    at_s: float
    change_pa: float
    over_s: float = 0.0

    def apply(self, on: Surroundings) -> None:
        """Add the change."""
        on.ambient_pa[:] += self.change_pa * _event_share(on.time_s, self.at_s, self.over_s)


@dataclass(frozen=True, slots=True)
class AirTemperatureChange:
    """Air temperature changes: heating comes on."""

    at_s: float
    change_k: float
    over_s: float = 0.0

    def apply(self, on: Surroundings) -> None:
        """Add the change."""
        on.air_k[:] += self.change_k * _event_share(on.time_s, self.at_s, self.over_s)


@dataclass(frozen=True, slots=True)
class LeakChange:
    """The leak grows by `factor`."""

    at_s: float
    factor: float = 2.0

    def apply(self, on: Surroundings) -> None:
        """Multiply the leak from then on."""
        on.leak_factor[on.time_s >= self.at_s] *= self.factor


@dataclass(frozen=True, slots=True)
class LaserDropout:
    """The laser gets no light back for a while."""

    at_s: float
    duration_s: float

    def apply(self, on: Surroundings) -> None:
        """Mark the steps without light."""
        on.laser_lost[(on.time_s >= self.at_s) & (on.time_s < self.at_s + self.duration_s)] = 1.0


@dataclass(frozen=True, slots=True)
class LaserDrift:
    """The laser's mount moves at a rate for a while, then stays."""

    at_s: float
    rate_um_per_min: float
    duration_s: float = np.inf

    def apply(self, on: Surroundings) -> None:
        """Add the motion so far."""
        on.laser_bias_um[:] += (
            self.rate_um_per_min / 60 * np.clip(on.time_s - self.at_s, 0, self.duration_s)
        )


@dataclass(frozen=True, slots=True)
class DailyTemperature:
    """The room follows the day: a sine of one day, warmest after `warmest_s`."""

    amplitude_k: float
    warmest_s: float = 54_000.0

    def apply(self, on: Surroundings) -> None:
        """Add the day's course."""
        on.air_k[:] += self.amplitude_k * np.cos(2 * np.pi / _DAY_S * (on.time_s - self.warmest_s))


@dataclass(frozen=True, slots=True)
class PressureWeather:
    """Highs and lows: a sum of sines with periods of 12 h to 10 days and random phases, starting at
    0.

    Stateless, so that blocks can be made in any order; equal amplitudes give the slow ones the
    largest changes and the fast ones the steepest: with 700 Pa (a lively month) some 50 Pa an hour.
    """

    std_pa: float
    seed: int = 0

    def apply(self, on: Surroundings) -> None:
        """Add the weather."""
        # A sum of sines of equal amplitude with random phases, 0 at the start
        periods_s = np.geomspace(0.5 * _DAY_S, 10 * _DAY_S, 12)
        phases = np.random.default_rng(self.seed).uniform(0, 2 * np.pi, periods_s.size)
        amplitude_pa = self.std_pa * np.sqrt(2 / periods_s.size)
        for period_s, phase in zip(periods_s, phases, strict=True):
            wave = np.sin(2 * np.pi / period_s * on.time_s + phase) - np.sin(phase)
            on.ambient_pa[:] += amplitude_pa * wave


def _event_share(time_s: Series, at_s: float, over_s: float) -> Series:
    """0 before the event, 1 after it, a straight line while it lasts."""
    if over_s <= 0:
        return (time_s >= at_s).astype(np.float64)
    return np.clip((time_s - at_s) / over_s, 0, 1)
