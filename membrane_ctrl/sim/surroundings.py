"""The weather of the simulated bench, and what disturbs it in blocks of steps."""

import math
from collections.abc import Sequence
from itertools import accumulate

import numpy as np

from membrane_ctrl.config.schema import TwinConfig
from membrane_ctrl.sim import gas
from membrane_ctrl.sim.bench_events import BenchEvent, Series, Surroundings

# scenario: (air pressure std Pa, correlation time s), (air temperature std K, correlation time s)
SCENARIOS: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "calm": ((0.0, 30.0), (0.0, 300.0)),
    "quiet": ((0.2, 30.0), (0.010, 300.0)),
    "typical": ((1.2, 30.0), (0.050, 300.0)),
    "gusty": ((4.0, 20.0), (0.100, 300.0)),
}


class OrnsteinUhlenbeck:
    """Noise that forgets exponentially, exact at the steps, stationary from the first one.

    x' = x exp(-dt/tau) + std sqrt(1 - exp(-2 dt/tau)) N(0, 1).

    Parameters
    ----------
    std : float
        Standard deviation, in the unit of the values.
    correlation_s : float
        tau.
    step_s : float
        dt.
    rng : Generator
        Draws the steps.
    """

    def __init__(
        self, std: float, correlation_s: float, step_s: float, rng: np.random.Generator
    ) -> None:
        self._decay = math.exp(-step_s / correlation_s)
        self._kick = std * math.sqrt(-math.expm1(-2 * step_s / correlation_s))
        self._rng = rng
        self._value = std * float(rng.standard_normal())

    def next_values(self, steps: int) -> Series:
        """The next values, (steps,)."""
        decay = self._decay
        kicks = (self._kick * self._rng.standard_normal(steps)).tolist()
        values = list(accumulate(kicks, lambda x, kick: decay * x + kick, initial=self._value))
        self._value = values[-1]
        return np.array(values[:-1])


class Disturbance:
    """The surroundings in blocks of steps: scenario, drift of the laser's mount, events.

    Parameters
    ----------
    config : TwinConfig
        Scenario of the weather, and drift of the mount.
    events : sequence of BenchEvent
        Each changes the blocks in which it happens.
    step_s : float
        Length of a step.
    rng : Generator
        Draws the weather.
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

    def next_steps(self, steps: int) -> Surroundings:
        """The next `steps` steps."""
        time_s: Series = np.arange(self._next, self._next + steps, dtype=np.float64) * self._step_s
        self._next += steps
        block = Surroundings(
            time_s=time_s,
            ambient_pa=gas.STANDARD_AMBIENT_PA + self._pressure.next_values(steps),
            air_k=gas.REFERENCE_K + self._temperature.next_values(steps),
            leak_factor=np.ones(steps),
            laser_bias_um=np.multiply(self._drift_um_per_s, time_s),
            laser_lost=np.zeros(steps),
        )
        for event in self._events:
            event.apply(block)
        return block
