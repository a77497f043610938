"""Surroundings of the simulated bench: the weather of a scenario, and events at a time, which add
their effect.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Protocol

import numpy as np

from membrane_ctrl.config.schema import TwinConfig
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim import film

Series = FloatArray
# scenario: (air pressure std Pa, correlation time s), (air temperature std K, correlation time s)
SCENARIOS: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "calm": ((0.0, 30.0), (0.0, 300.0)),
    "quiet": ((0.2, 30.0), (0.010, 300.0)),
    "typical": ((1.2, 30.0), (0.050, 300.0)),
    "gusty": ((4.0, 20.0), (0.100, 300.0)),
}


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


class OrnsteinUhlenbeck:
    """Noise that forgets exponentially, exact at the steps, stationary from the first one.

    x' = x exp(-dt/tau) + std sqrt(1 - exp(-2 dt/tau)) N(0, 1).
    """

    def __init__(
        self, std: float, correlation_s: float, step_s: float, rng: np.random.Generator
    ) -> None:
        self._decay = math.exp(-step_s / correlation_s)
        self._kick = std * math.sqrt(-math.expm1(-2 * step_s / correlation_s))
        self._rng = rng
        self._value = std * float(rng.standard_normal())

    def block(self, steps: int) -> Series:
        """The next values, (steps,)."""
        decay = self._decay
        kicks = (self._kick * self._rng.standard_normal(steps)).tolist()
        values = list(accumulate(kicks, lambda x, kick: decay * x + kick, initial=self._value))
        self._value = values[-1]
        return np.array(values[:-1])


class Disturbance:
    """The surroundings in blocks of consecutive steps: scenario, drift of the laser's mount,
    events.
    """

    def __init__(
        self,
        config: TwinConfig,
        events: Sequence[BenchEvent],
        step_s: float,
        rng: np.random.Generator,
    ) -> None:
        pressure, temperature = SCENARIOS[config.scenario]
        pressure_rng, temperature_rng = rng.spawn(2)
        self._pressure = OrnsteinUhlenbeck(*pressure, step_s, pressure_rng)
        self._temperature = OrnsteinUhlenbeck(*temperature, step_s, temperature_rng)
        self._drift_um_per_s = config.laser_drift_um_per_min / 60
        self._events = tuple(events)
        self._step_s = step_s
        self._next = 0

    def block(self, steps: int) -> Surroundings:
        """The next `steps` steps."""
        time_s: Series = np.arange(self._next, self._next + steps, dtype=np.float64) * self._step_s
        self._next += steps
        block = Surroundings(
            time_s=time_s,
            ambient_pa=film.STANDARD_AMBIENT_PA + self._pressure.block(steps),
            air_k=film.REFERENCE_K + self._temperature.block(steps),
            leak_factor=np.ones(steps),
            laser_bias_um=np.multiply(self._drift_um_per_s, time_s),
            laser_lost=np.zeros(steps),
        )
        for event in self._events:
            event.apply(block)
        return block


# Events.


_DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class AmbientChange:
    """Air pressure changes: a door (20 Pa at once), weather (100 Pa over 600 s)."""

    at_s: float
    change_pa: float
    over_s: float = 0.0

    def apply(self, on: Surroundings) -> None:
        """Add the change."""
        on.ambient_pa[:] += self.change_pa * _progress(on.time_s, self.at_s, self.over_s)


@dataclass(frozen=True, slots=True)
class AirTemperatureChange:
    """Air temperature changes: heating comes on."""

    at_s: float
    change_k: float
    over_s: float = 0.0

    def apply(self, on: Surroundings) -> None:
        """Add the change."""
        on.air_k[:] += self.change_k * _progress(on.time_s, self.at_s, self.over_s)


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
        periods_s = np.geomspace(0.5 * _DAY_S, 10 * _DAY_S, 12)
        phases = np.random.default_rng(self.seed).uniform(0, 2 * np.pi, periods_s.size)
        for period_s, phase in zip(periods_s, phases, strict=True):
            wave = np.sin(2 * np.pi / period_s * on.time_s + phase) - np.sin(phase)
            on.ambient_pa[:] += self.std_pa * np.sqrt(2 / periods_s.size) * wave


def _progress(time_s: Series, at_s: float, over_s: float) -> Series:
    """0 before the event, 1 after it, a straight line while it lasts."""
    if over_s <= 0:
        return (time_s >= at_s).astype(np.float64)
    return np.clip((time_s - at_s) / over_s, 0, 1)
