"""The sensors of the simulated bench: their noise, their resolution and the laser's dropouts."""

import math

import numpy as np

from firmware_iface.emulators.pump_board import BoardSample
from membrane_ctrl.config.schema import TwinConfig
from membrane_ctrl.sim.truth import Truth

GAUGE_NOISE_PA = 0.5  # a +-1 kPa differential sensor (assumed): 10 µm of centre, so a monitor only
# An infrared thermometer, a resistor, and a capacitive hygrometer (assumed)
FILM_NOISE_K = 0.05
RING_NOISE_K = 0.01
HUMIDITY_NOISE_PERCENT = 0.1
_CLIMATE_NOISE = 77  # of the seed
LASER_GOOD = 0
LASER_NO_LIGHT = 1


class Sensors:
    """Laser, barometer, gauge and thermometers with independent noise in each sample.

    Parameters
    ----------
    config : TwinConfig
        Noise and resolution of the sensors, and whether there is a laser.
    rng : Generator
        Draws the noise; that of the climate's sensors has a generator of its own.
    """

    def __init__(self, config: TwinConfig, rng: np.random.Generator) -> None:
        self._config = config
        self._rng = rng
        self._counter = 0
        # Of their own, so that the other sensors have the same noise in every climate
        self._climate_rng = np.random.default_rng([config.seed, _CLIMATE_NOISE])

    def read(self, truth: Truth) -> BoardSample:
        """A new sample; the counter advances by one. Without light the displacement is NaN, its
        quality not 0.
        """
        # Five random numbers each time, whatever is lost: a fault does not change the other noises.
        config = self._config
        laser, gauge, ambient, air, gas = self._rng.standard_normal(5).tolist()
        lost = truth.laser_lost > 0 or not config.laser
        displacement_um = math.nan
        quality = LASER_NO_LIGHT
        if not lost:
            noise_um = config.laser_noise_um * laser
            reading_um = truth.displacement_um + truth.laser_bias_um + noise_um
            displacement_um = _quantise_value(reading_um, config.laser_resolution_um)
            quality = LASER_GOOD

        # Sensors of the climate, with a generator of their own.
        self._counter += 1
        film_c = ring_c = humidity_percent = math.nan
        if math.isfinite(truth.humidity_percent):
            film, ring, humidity = self._climate_rng.standard_normal(3).tolist()
            film_c = truth.film_temperature_c + FILM_NOISE_K * film
            ring_c = truth.ring_temperature_c + RING_NOISE_K * ring
            humidity_percent = truth.humidity_percent + HUMIDITY_NOISE_PERCENT * humidity
        return BoardSample(
            displacement_um=displacement_um,
            displacement_quality=quality,
            gauge_pressure_pa=truth.gauge_pressure_pa + GAUGE_NOISE_PA * gauge,
            ambient_pressure_pa=truth.ambient_pressure_pa + config.barometer_noise_pa * ambient,
            air_temperature_c=truth.air_temperature_c + config.thermometer_noise_k * air,
            gas_temperature_c=truth.gas_temperature_c + config.thermometer_noise_k * gas,
            sample_counter=self._counter,
            device_time_s=truth.time_s,
            film_temperature_c=film_c,
            ring_temperature_c=ring_c,
            humidity_percent=humidity_percent,
        )


def _quantise_value(value: float, resolution: float) -> float:
    if resolution > 0:
        return round(value / resolution) * resolution
    return value
