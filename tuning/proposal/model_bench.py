"""The fitted plant as a bench, in the identified weather.

Linear prediction ignores that the pump only adds gas, stalls and starts. Here a pump with the
configured curve drives the identified delay, lag, gain and leak.
"""

import math

import numpy as np

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.control.experiments.experiment import BenchSample
from tuning.identification import plant_model
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal.disturbance_states import Walks
from tuning.proposal.driven_centre import DrivenCentre

# arbitrary: only changes matter
_LEVEL_PA = 101_325.0
_LEVEL_C = 23.0


class ModelBench:
    """A simulated bench made from the identified models; equal seeds give equal weather.

    `leak_step` has the time in s and the size in µm/s of a step of the leak.
    """

    def __init__(
        self,
        model: plant_model.PlantModel,
        disturbance: DisturbanceModel,
        pump: PumpConfig,
        seed: int,
        leak_step: tuple[float, float] = (math.inf, 0.0),
    ) -> None:
        self._model = model
        self._disturbance = disturbance
        self._leak_step = leak_step
        self._rng = np.random.default_rng(seed)
        self._dt_s = disturbance.rest.dt_s
        self._driven = DrivenCentre(model, pump, model.holding_flow_um_per_s, self._dt_s)
        self._leaked_um = 0.0
        self._walks = Walks.from_disturbance(disturbance)
        self._transition, kicks = self._walks.discretise(self._dt_s)
        sizes, ways = np.linalg.eigh(kicks)
        self._kicks = ways * np.sqrt(np.maximum(sizes, 0.0))
        self._weather = np.zeros(len(kicks))
        self._ticks = 0
        self.true_um: list[float] = []

    def exchange(self, pump_fraction: float, vent_fraction: float) -> BenchSample:
        """Run one tick. The vent is assumed as during the identification of the leak."""
        at_s, size = self._leak_step
        leak = self._model.leak_um_per_s + (size if self._ticks * self._dt_s >= at_s else 0.0)
        self._leaked_um += leak * self._dt_s
        self._driven.step(pump_fraction)
        self._weather = self._transition @ self._weather + self._kicks @ self._rng.standard_normal(
            self._weather.size
        )
        return self._read_sample()

    def _read_sample(self) -> BenchSample:
        of, walks = self._disturbance, self._walks
        true_um = self._driven.way_um - self._leaked_um + float(walks.centre @ self._weather)
        self.true_um.append(true_um)
        self._ticks += 1
        laser, pressure, temperature = self._rng.standard_normal(3).tolist()
        return BenchSample(
            true_um + of.laser_um * laser,
            _LEVEL_PA + float(walks.barometer @ self._weather) + of.barometer.noise * pressure
            if of.barometer
            else math.nan,
            _LEVEL_C + float(walks.air @ self._weather) + of.air.noise * temperature
            if of.air
            else math.nan,
        )
