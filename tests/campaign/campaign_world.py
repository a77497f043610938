"""The mirrors of the campaign: the twin's own, and others with parameters drawn from the seed."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import PumpConfig, TwinConfig
from membrane_ctrl.sim.bench_events import BenchEvent
from membrane_ctrl.sim.plant import STEP_S, Plant

SCENARIOS = ("calm", "quiet", "typical", "gusty")
NOMINAL_SEEDS = range(1, 3)  # the twin as it is; all other seeds draw a mirror
_PRESSURE_PA, _LEAK_UM_PER_S, _LEAK_TIME_CONSTANT_S = 600.0, 1.24, 1.0e4


@dataclass(frozen=True)
class World:
    """What the controller does not know of the mirror: its deviation from the configuration.

    Attributes
    ----------
    scenario : str
        The weather.
    pump_gain, leak : float
        Flow and leak over the nominal ones.
    softness : float
        Sag over the nominal one at equal pressure.
    transport_s : float
        Of the gas from the pump to the film.
    """

    scenario: str = "calm"
    pump_gain: float = 1.0
    leak: float = 1.0
    softness: float = 1.0
    transport_s: float = 0.075

    @property
    def pressure_pa(self) -> float:
        """Gauge pressure at which the mirror is held."""
        return float(_PRESSURE_PA / self.softness**3)

    @property
    def holding_flow_um_per_s(self) -> float:
        """Nominal flow that keeps the mirror in place."""
        return _LEAK_UM_PER_S * self.leak / self.pump_gain

    def twin(self, seed: int) -> TwinConfig:
        """The configuration of the twin."""
        return TwinConfig(
            seed=seed,
            scenario=self.scenario,  # type: ignore[arg-type]  # one of SCENARIOS
            start_error_um=-15.0,
            leak_time_constant_s=_LEAK_TIME_CONSTANT_S / self.leak,
        )


def world_of(seed: int, rng: np.random.Generator) -> World:
    """The mirror of a seed."""
    scenario = str(rng.choice(SCENARIOS))
    if seed in NOMINAL_SEEDS:
        return World(scenario)
    gain, leak, softness, transport_s = rng.uniform(
        [0.8, 0.7, 0.985, 0.04], [1.25, 1.3, 1.015, 0.15]
    ).tolist()
    return World(scenario, gain, leak, softness, transport_s)


class WatchedPlant(Plant):
    """A plant of a world that notes the drive of its actuators.

    Attributes
    ----------
    pump_given, vent_given : float
        Drive of the pump's motor and of the valve, by any sender.
    """

    def __init__(
        self, world: World, twin: TwinConfig, pump: PumpConfig, events: Sequence[BenchEvent] = ()
    ) -> None:
        self._softness = world.softness
        self.pump_given = self.vent_given = 0.0
        real = pump.model_copy(
            update={"flow_full_um_per_s": world.pump_gain * pump.flow_full_um_per_s}
        )
        super().__init__(twin, real, events)
        self._pump._tube = deque([self._inflow_ml_per_s] * round(world.transport_s / STEP_S))

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        """Set the commands, and note them."""
        super().actuate(pump_fraction, vent_fraction)
        self.pump_given, self.vent_given = pump_fraction, vent_fraction

    def _load_block(self) -> None:
        super()._load_block()
        for of_root in (self._sag, self._back_sag, self._volume):
            of_root[:] = [self._softness * value for value in of_root]
