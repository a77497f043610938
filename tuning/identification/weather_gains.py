"""Gains of the weather on the centre, by regression on barometer and lagged air temperature.

    z = c t + g_p p + g_T lag(T_air) + n,    n = IMA(1,1)

z are the readings without the pump's motion. All columns are differenced and prewhitened with
1 / (1 - beta B), on means over blocks. A noisy sensor makes its gain too small (errors in
variables): white noise of variance r has the variance 2 r / (1 + beta) after the filter, which is
taken off the diagonal of the normal equations.
Source: Fuller, Measurement Error Models (1987), section 2.2.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from membrane_ctrl.control.filters import lag_step_fraction
from tuning.identification import plant_model
from tuning.identification.noise_spectrum import (
    Coloured,
    compute_coloured_psd,
    fit_noise,
    remove_pump_motion_um,
)
from tuning.identification.record import Record, Series

_BLOCK_S = 0.5  # with shorter blocks a barometer's noise hides its signal; longer ones blur events
_KNOWN_SHARE = 0.1  # standard error over the gain, up to which the fitted gain is used
_AGREEING_SIGMAS = 3.0
_MOST_BETA = 0.99  # of the noise
# Most of a sensor's variance that may be noise: one that shows only noise must not make the matrix
# singular.
_MOST_NOISE_SHARE = 0.9


@dataclass(frozen=True, slots=True)
class WeatherGain:
    """A gain of the weather on the centre, and the motion of the sensor's quantity.

    Attributes
    ----------
    gain, sigma : float
        µm per Pa or µm per K, and its standard error.
    walk : float
        Variance per second of the quantity's random walk, Pa^2/s or K^2/s.
    noise : float
        Standard deviation of a reading, Pa or K.
    lag_s : float
        Lag of the quantity's effect on the centre.
    coloured : tuple of (float, float)
        The quantity's motion that is no walk, as in `noise_spectrum.Coloured`.
    """

    gain: float
    sigma: float
    walk: float
    noise: float
    lag_s: float
    coloured: Coloured = ()

    def psd(self, w_rad_per_s: Series) -> Series:
        """Two-sided spectrum of the quantity, unit^2 s."""
        return self.walk / w_rad_per_s**2 + compute_coloured_psd(self.coloured, w_rad_per_s)

    def choose_gain(self, configured: float) -> float:
        """Gain to use: the fitted one if known to 10 %, else the configured one if they agree.

        Steady weather reveals nothing about its gain; the bench's physics is then the better
        source.
        """
        if self.sigma <= _KNOWN_SHARE * abs(self.gain):
            return self.gain
        if abs(self.gain - configured) <= _AGREEING_SIGMAS * self.sigma:
            return configured
        return self.gain


@dataclass(frozen=True, slots=True)
class WeatherFit:
    """Both gains (None without the sensor), and the readings without the weather."""

    barometer: WeatherGain | None
    air: WeatherGain | None
    rest_um: Series


def lag_series(series: Series, lag_s: float, dt_s: float) -> Series:
    """Return a series behind a first-order lag that starts at its first value.

    Parameters
    ----------
    series : (n,) array
        The values.
    lag_s : float
        Time constant.
    dt_s : float
        Time between samples.

    Returns
    -------
    (n,) array
    """
    share = lag_step_fraction(dt_s, lag_s)
    from_first = series - series[0]
    followed = np.asarray(lfilter([share], [1.0, share - 1.0], from_first), dtype=float)
    return followed + float(series[0])


def fit_weather(
    record: Record, model: plant_model.PlantModel, gas_follows_air_s: float
) -> WeatherFit:
    """Regress the motion that the pump does not cause on the weather.

    Parameters
    ----------
    record : Record
        A quiet hold of some minutes.
    model : PlantModel
        Gain, delay and lag of the pump.
    gas_follows_air_s : float
        Lag of the gas behind the air's temperature.

    Returns
    -------
    WeatherFit

    Raises
    ------
    ValueError
        The record is too short for the sensors' noise (`fit_noise`).
    """
    # The sensors that the record has, with the lag of their effect.
    z = remove_pump_motion_um(record, model)
    channels: list[tuple[Series, float]] = []
    if record.has_barometer:
        channels.append((record.ambient_pressure_pa, 0.0))
    if record.has_thermometer:
        channels.append((record.air_temperature_c, gas_follows_air_s))
    if not channels:
        return WeatherFit(None, None, z)
    noises = [fit_noise(series, record.dt_s, 0.0) for series, _ in channels]
    columns = [lag_series(series, lag_s, record.dt_s) for series, lag_s in channels]

    # Variance of the noise in a block's mean. Of a lagged sensor's noise only dt / (2 T) of the
    # variance passes the lag.
    per_block = max(1, round(_BLOCK_S / record.dt_s))
    variances = []
    for noise, (_, lag_s) in zip(noises, channels, strict=True):
        passing_share = 1.0
        if lag_s > 0:
            passing_share = record.dt_s / (2 * lag_s)
        variances.append(noise.white**2 * passing_share / per_block)
    gains, sigmas = _regress_gains(z, columns, np.array(variances), per_block)
    found = [
        WeatherGain(float(gain), float(sigma), noise.fast, noise.white, lag_s, noise.coloured)
        for gain, sigma, noise, (_, lag_s) in zip(gains, sigmas, noises, channels, strict=True)
    ]

    # The readings without pump and weather.
    explained = sum(
        gain * (column - column[0]) for gain, column in zip(gains, columns, strict=True)
    )
    barometer = None
    if record.has_barometer:
        barometer = found[0]
    air = None
    if record.has_thermometer:
        air = found[-1]
    return WeatherFit(barometer, air, np.asarray(z - explained, dtype=float))


def _regress_gains(
    z: Series, columns: list[Series], variances: Series, per_block: int
) -> tuple[Series, Series]:
    """Regress the readings on the sensors, with the best-fitting beta of the noise.

    Parameters
    ----------
    z : (n,) array
        Readings without the pump's motion, µm.
    columns : list of (n,) arrays
        The k sensors behind their lags.
    variances : (k,) array
        Variance of the noise in a block's mean.
    per_block : int
        Samples of a block.

    Returns
    -------
    gains, sigmas : (k,) arrays
    """
    # Increments of the means over blocks, less their mean: a drift is no effect of the weather.
    used = z.size // per_block * per_block
    means = [column[:used].reshape(-1, per_block).mean(axis=1) for column in (z, *columns)]
    moved = np.diff(np.array(means), axis=1)
    moved -= moved.mean(axis=1, keepdims=True)

    def regress(beta: float) -> tuple[Series, Series, float]:
        """Gains, sigmas and variance of the residual, for one beta."""
        white = lfilter([1.0], [1.0, -beta], moved, axis=1)
        target = white[0]
        given = white[1:]

        # Normal equations without the sensors' own noise (Fuller).
        normal = given @ given.T
        expected_noise = 2 * variances / (1 + beta) * target.size
        noise = np.minimum(expected_noise, _MOST_NOISE_SHARE * np.diag(normal))
        inverse = np.linalg.inv(normal - np.diag(noise))
        gains = inverse @ given @ target

        rest = target - gains @ given
        variance = float(rest @ rest) / (target.size - len(gains) - 1)
        covariance = inverse @ normal @ inverse
        return gains, np.sqrt(np.diag(covariance) * variance), variance

    best = minimize_scalar(
        lambda beta: math.log(regress(beta)[2]), bounds=(0.0, _MOST_BETA), method="bounded"
    )
    gains, sigmas, _ = regress(float(best.x))
    return gains, sigmas
