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

# Levels about which the weather moves; only changes matter.
_LEVEL_PA = 101_325.0
_LEVEL_C = 23.0


class ModelBench:
    """A simulated bench made from the identified models; equal seeds give equal weather.

    Parameters
    ----------
    model : PlantModel
        The plant.
    disturbance : DisturbanceModel
        Noise of the sensors, and the weather that is simulated.
    pump : PumpConfig
        The pump's curve.
    seed : int
        Of the weather and the noise.
    leak_step : (float, float)
        Time in s and size in µm/s of a step of the leak.

    Attributes
    ----------
    true_um : list of float
        The centre at each tick.
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
        # Root of the covariance, from independent Gaussian numbers to a tick's kicks.
        variances, directions = np.linalg.eigh(kicks)
        self._kicks = directions * np.sqrt(np.maximum(variances, 0.0))
        self._weather = np.zeros(len(kicks))
        self._ticks = 0
        self.true_um: list[float] = []

    def exchange(self, pump_fraction: float, vent_fraction: float) -> BenchSample:
        """Run one tick.

        Parameters
        ----------
        pump_fraction : float
            Command of the pump.
        vent_fraction : float
            Has no effect: the leak was identified with the vent as it is.
        """
        step_s, step_um_per_s = self._leak_step
        leak_um_per_s = self._model.leak_um_per_s
        if self._ticks * self._dt_s >= step_s:
            leak_um_per_s = leak_um_per_s + step_um_per_s
        self._leaked_um += leak_um_per_s * self._dt_s
        self._driven.step(pump_fraction)
        random = self._rng.standard_normal(self._weather.size)
        self._weather = self._transition @ self._weather + self._kicks @ random
        return self._read_sample()

    def _read_sample(self) -> BenchSample:
        """The sensors' readings, with their noise; NaN for a sensor that was not identified."""
        # The true centre: gas that the pump has given, less what has leaked, plus the weather. The
        # sensors of the weather show the same states with their own noise.
        disturbance = self._disturbance
        walks = self._walks
        moved_um = self._driven.way_um - self._leaked_um
        true_um = moved_um + float(walks.centre @ self._weather)
        self.true_um.append(true_um)
        self._ticks += 1

        # Always three numbers, so that the sensors present do not change the random course.
        laser, pressure, temperature = self._rng.standard_normal(3).tolist()
        pressure_pa = math.nan
        if disturbance.barometer is not None:
            true_pa = _LEVEL_PA + float(walks.barometer @ self._weather)
            pressure_pa = true_pa + disturbance.barometer.noise * pressure
        temperature_c = math.nan
        if disturbance.air is not None:
            true_c = _LEVEL_C + float(walks.air @ self._weather)
            temperature_c = true_c + disturbance.air.noise * temperature
        return BenchSample(true_um + disturbance.laser_um * laser, pressure_pa, temperature_c)
