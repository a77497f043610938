"""All disturbances of the mirror, as spectra: explained by the weather sensors, and not."""

import math
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import LoopConfig
from tuning.identification import closed_loop, plant_model
from tuning.identification.noise_spectrum import FLOOR, Noise, fit_noise
from tuning.identification.record import Record, Series
from tuning.identification.weather_gains import WeatherGain, fit_weather

_BLOCKS = 10  # of a record, whose variances show how steady the weather is


@dataclass(frozen=True, slots=True)
class DisturbanceModel:
    """Disturbances of the centre, and the laser's noise."""

    rest: Noise  # the laser's noise and the walks that no weather sensor explains
    barometer: WeatherGain | None  # the part explained by the sensors
    air: WeatherGain | None
    # Relative, 1 sigma: how far the standard deviation of ten other minutes may be from the one
    # predicted, by weather that comes and goes (gusts)
    unsteady: float = 0.0

    @property
    def laser_um(self) -> float:
        """Standard deviation of a reading."""
        return self.rest.white

    def psd(self, w_rad_per_s: Series, model: plant_model.PlantModel, loop: LoopConfig) -> Series:
        """Two-sided spectrum of the centre without feedback but with the loop's feed-forward, µm^2
        s.

        The feed-forward takes a channel's movement x away as far as the pump is in time: x (1 - H),
        with H the pump behind the feed-forward's filter; the sensor's noise comes in through H.
        """
        dt_s = self.rest.dt_s
        pump = closed_loop.compute_pump_response(model, w_rad_per_s, dt_s)
        total = self.rest.moving_psd(w_rad_per_s)
        for weather, used, gain, filter_s in self._list_channels(loop):
            lag = 1 / (1 + 1j * w_rad_per_s * weather.lag_s)
            reaction = (
                gain * pump / (1 + 1j * w_rad_per_s * filter_s) if used else np.zeros_like(pump)
            )
            total = total + weather.psd(w_rad_per_s) * np.abs(weather.gain * lag - reaction) ** 2
            total = total + weather.noise**2 * dt_s * np.abs(reaction) ** 2
        return np.asarray(total, dtype=float)

    def feedforward_psd(self, w_rad_per_s: Series, loop: LoopConfig) -> Series:
        """Two-sided spectrum of the flow that the loop's feed-forward asks for, (µm/s)^2 s."""
        total = np.zeros_like(w_rad_per_s)
        for weather, used, gain, filter_s in self._list_channels(loop):
            rate = gain * w_rad_per_s / np.abs(1 + 1j * w_rad_per_s * filter_s) if used else 0.0
            total = total + rate**2 * (weather.psd(w_rad_per_s) + weather.noise**2 * self.rest.dt_s)
        return total

    def _list_channels(self, loop: LoopConfig) -> list[tuple[WeatherGain, bool, float, float]]:
        """Each weather sensor with its feed-forward: whether it is used, its gain and filter."""
        channels = (
            (
                self.barometer,
                loop.feedforward_barometer,
                loop.barometer_gain_um_per_pa,
                loop.feedforward_filter_s,
            ),
            (
                self.air,
                loop.feedforward_temperature,
                loop.temperature_gain_um_per_k,
                loop.gas_follows_air_s,
            ),
        )
        return [
            (of, used, gain, filter_s) for of, used, gain, filter_s in channels if of is not None
        ]


def observe_disturbance(
    record: Record, model: plant_model.PlantModel, loop: LoopConfig
) -> DisturbanceModel:
    """Weather gains and noise from a quiet hold under any loop. Raises ValueError if it is too
    short.
    """
    weather = fit_weather(record, model, loop.gas_follows_air_s)
    rest = fit_noise(weather.rest_um, record.dt_s, loop.gas_follows_air_s)
    found = DisturbanceModel(rest, weather.barometer, weather.air)
    return replace(
        found, unsteady=_std_uncertainty(record.filled_displacement_um(), found, model, loop)
    )


def _std_uncertainty(
    read_um: Series, found: DisturbanceModel, model: plant_model.PlantModel, loop: LoopConfig
) -> float:
    """Relative standard error of the centre's standard deviation, for this record and one more like
    it.

    From the scatter of the variance among blocks of the record, after Wiener's filter, which leaves
    the movement.
    """
    w = np.asarray(2 * np.pi * np.fft.rfftfreq(read_um.size, found.rest.dt_s), dtype=float)
    w[0] = w[1]
    moving = found.psd(w, model, loop)
    centre_um = np.fft.irfft(
        np.fft.rfft(read_um - read_um.mean()) * moving / (moving + found.rest.white_psd),
        read_um.size,
    )
    variances = np.mean(
        centre_um[: read_um.size // _BLOCKS * _BLOCKS].reshape(_BLOCKS, -1) ** 2, axis=1
    )
    return float(variances.std(ddof=1) / max(variances.mean(), FLOOR) / 2 * math.sqrt(2 / _BLOCKS))
