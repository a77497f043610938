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
    """Disturbances of the centre, and the laser's noise.

    Attributes
    ----------
    rest : Noise
        The laser's noise, and the walks that no weather sensor explains.
    barometer, air : WeatherGain or None
        The part that the sensors explain.
    unsteady : float
        Relative, 1 sigma: how far the standard deviation of ten other minutes may be from the
        predicted one, by weather that comes and goes (gusts).
    """

    rest: Noise
    barometer: WeatherGain | None
    air: WeatherGain | None
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

        Parameters
        ----------
        w_rad_per_s : (n,) array
            Angular frequencies.
        model : PlantModel
            The plant.
        loop : LoopConfig
            Which weather channels the feed-forward uses, with their gains and filters.

        Returns
        -------
        (n,) array
            µm^2 s.
        """
        dt_s = self.rest.dt_s
        pump = closed_loop.compute_pump_response(model, w_rad_per_s, dt_s)
        total = self.rest.moving_psd(w_rad_per_s)
        for weather, used, gain, filter_s in self._list_channels(loop):
            # The weather's own way to the centre, and the feed-forward's way through the pump.
            lag = 1 / (1 + 1j * w_rad_per_s * weather.lag_s)
            reaction = np.zeros_like(pump)
            if used:
                reaction = gain * pump / (1 + 1j * w_rad_per_s * filter_s)
            remaining = np.abs(weather.gain * lag - reaction) ** 2
            total = total + weather.psd(w_rad_per_s) * remaining

            # The sensor's noise, which only the feed-forward lets in.
            total = total + weather.noise**2 * dt_s * np.abs(reaction) ** 2
        return np.asarray(total, dtype=float)

    def feedforward_psd(self, w_rad_per_s: Series, loop: LoopConfig) -> Series:
        """Return the two-sided spectrum of the flow that the feed-forward commands.

        Parameters
        ----------
        w_rad_per_s : (n,) array
            Angular frequencies.
        loop : LoopConfig
            Which weather channels the feed-forward uses, with their gains and filters.

        Returns
        -------
        (n,) array
            (µm/s)^2 s.
        """
        total = np.zeros_like(w_rad_per_s)
        for weather, used, gain, filter_s in self._list_channels(loop):
            if not used:
                continue
            # The filtered rate of the reading times its gain, for a true change and for noise.
            rate = gain * w_rad_per_s / np.abs(1 + 1j * w_rad_per_s * filter_s)
            reading = weather.psd(w_rad_per_s) + weather.noise**2 * self.rest.dt_s
            total = total + rate**2 * reading
        return total

    def _list_channels(self, loop: LoopConfig) -> list[tuple[WeatherGain, bool, float, float]]:
        """Each weather sensor with its feed-forward: whether it is used, its gain and filter."""
        channels = []
        if self.barometer is not None:
            used = loop.feedforward_barometer
            gain_um_per_pa = loop.barometer_gain_um_per_pa
            channels.append((self.barometer, used, gain_um_per_pa, loop.feedforward_filter_s))
        if self.air is not None:
            used = loop.feedforward_temperature
            gain_um_per_k = loop.temperature_gain_um_per_k
            channels.append((self.air, used, gain_um_per_k, loop.gas_follows_air_s))
        return channels


def observe_disturbance(
    record: Record, model: plant_model.PlantModel, loop: LoopConfig
) -> DisturbanceModel:
    """Fit weather gains and noise to a quiet hold under any loop.

    Parameters
    ----------
    record : Record
        The hold.
    model : PlantModel
        The identified plant.
    loop : LoopConfig
        The loop that held, with its feed-forward.

    Returns
    -------
    DisturbanceModel

    Raises
    ------
    ValueError
        The record is too short.
    """
    weather = fit_weather(record, model, loop.gas_follows_air_s)
    rest = fit_noise(weather.rest_um, record.dt_s, loop.gas_follows_air_s)
    found = DisturbanceModel(rest, weather.barometer, weather.air)
    unsteady = _std_uncertainty(record.filled_displacement_um(), found, model, loop)
    return replace(found, unsteady=unsteady)


def _std_uncertainty(
    read_um: Series, found: DisturbanceModel, model: plant_model.PlantModel, loop: LoopConfig
) -> float:
    """Relative standard error of the centre's standard deviation, for this record and one more like
    it.

    From the scatter of the variance among blocks of the record, after Wiener's filter, which leaves
    the movement.
    """
    # Wiener's filter: the share of the movement in the spectrum of the reading.
    frequencies_hz = np.fft.rfftfreq(read_um.size, found.rest.dt_s)
    w = np.asarray(2 * np.pi * frequencies_hz, dtype=float)
    w[0] = w[1]
    moving = found.psd(w, model, loop)
    spectrum = np.fft.rfft(read_um - read_um.mean())
    filtered = spectrum * moving / (moving + found.rest.white_psd)
    centre_um = np.fft.irfft(filtered, read_um.size)

    # Variances of the blocks; a relative error of a variance is twice that of its root.
    used = read_um.size // _BLOCKS * _BLOCKS
    variances = np.mean(centre_um[:used].reshape(_BLOCKS, -1) ** 2, axis=1)
    scatter = variances.std(ddof=1) / max(variances.mean(), FLOOR)
    two_records = math.sqrt(2 / _BLOCKS)
    return float(scatter / 2 * two_records)
