"""All that moves the mirror, as spectra: what is explained by the weather's sensors and what is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config import LoopConfig
from tuning.disturbance import Noise, fit_noise
from tuning.feedforward_fit import WeatherGain, fit_weather
from tuning.loop_model import pump_response
from tuning.plant_model import PlantModel
from tuning.records import Record, Series


@dataclass(frozen=True, slots=True)
class Disturbance:
    """What moves the centre, and what the laser adds.

    Attributes
    ----------
    rest : Noise
        The laser's noise and the walks that no weather sensor explains.
    barometer, air : WeatherGain or None
        What the sensors explain.
    """

    rest: Noise
    barometer: WeatherGain | None
    air: WeatherGain | None

    @property
    def laser_um(self) -> float:
        """Standard deviation of a reading."""
        return self.rest.white

    def psd(self, w_rad_per_s: Series, model: PlantModel, loop: LoopConfig) -> Series:
        """Two-sided spectrum of the centre without feedback but with the loop's feed-forward, um^2 s.

        The feed-forward takes a channel's movement x away as far as the pump is in time: x (1 - H), with H the pump
        behind the feed-forward's filter; the sensor's noise comes in through H.
        """
        dt_s = self.rest.dt_s
        pump = pump_response(model, w_rad_per_s, dt_s)
        total = self.rest.moving_psd(w_rad_per_s)
        channels = (
            (self.barometer, loop.feedforward_barometer, loop.barometer_gain_um_per_pa, loop.feedforward_filter_s),
            (self.air, loop.feedforward_temperature, loop.temperature_gain_um_per_k, loop.gas_follows_air_s),
        )
        for weather, used, gain, filter_s in channels:
            if weather is None:
                continue
            lag = 1 / (1 + 1j * w_rad_per_s * weather.lag_s)
            reaction = gain * pump / (1 + 1j * w_rad_per_s * filter_s) if used else np.zeros_like(pump)
            total = total + weather.walk / w_rad_per_s**2 * np.abs(weather.gain * lag - reaction) ** 2
            total = total + weather.noise**2 * dt_s * np.abs(reaction) ** 2
        return np.asarray(total, dtype=float)


def observe(record: Record, model: PlantModel, loop: LoopConfig) -> Disturbance:
    """Weather gains and noise from a quiet hold under any loop. Raises ValueError if it is too short."""
    weather = fit_weather(record, model, loop.gas_follows_air_s)
    return Disturbance(
        fit_noise(weather.rest_um, record.dt_s, loop.gas_follows_air_s), weather.barometer, weather.air
    )
