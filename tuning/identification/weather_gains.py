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


@dataclass(frozen=True, slots=True)
class WeatherGain:
    """A gain, its standard error, and the random walk of the sensor's quantity."""

    gain: float  # µm per Pa or µm per K
    sigma: float
    walk: float  # variance per second of the quantity's random walk, Pa^2/s or K^2/s
    noise: float  # standard deviation of a reading
    lag_s: float  # lag of the quantity's effect on the centre
    coloured: Coloured = ()  # the quantity's movement that is no walk

    def psd(self, w_rad_per_s: Series) -> Series:
        """Two-sided spectrum of the quantity, unit^2 s."""
        return self.walk / w_rad_per_s**2 + compute_coloured_psd(self.coloured, w_rad_per_s)

    def choose_gain(self, configured: float) -> float:
        """Gain to use: the fitted one if known to 10 %, else the configured one if they agree.

        Steady weather reveals nothing about its gain; the bench's physics is then the better
        source.
        """
        if self.sigma <= 0.1 * abs(self.gain):
            return self.gain
        return configured if abs(self.gain - configured) <= 3 * self.sigma else self.gain


@dataclass(frozen=True, slots=True)
class WeatherFit:
    """Both gains (None without the sensor), and the readings without the weather."""

    barometer: WeatherGain | None
    air: WeatherGain | None
    rest_um: Series


def lag_series(series: Series, lag_s: float, dt_s: float) -> Series:
    """First-order lag that starts at its first input."""
    share = lag_step_fraction(dt_s, lag_s)
    followed = np.asarray(lfilter([share], [1.0, share - 1.0], series - series[0]), dtype=float)
    return followed + float(series[0])


def fit_weather(
    record: Record, model: plant_model.PlantModel, gas_follows_air_s: float
) -> WeatherFit:
    """Regress the motion not caused by the pump on the weather.

    `record` is a quiet hold of some minutes, `gas_follows_air_s` the lag of the gas behind the air.
    """
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
    # of a lagged sensor's noise only dt / (2 T) of the variance passes the lag
    shares = [1.0 if lag_s == 0 else record.dt_s / (2 * lag_s) for _, lag_s in channels]
    per_block = max(1, round(_BLOCK_S / record.dt_s))
    variances = np.array(
        [n.white**2 * share / per_block for n, share in zip(noises, shares, strict=True)]
    )
    gains, sigmas = _regress_gains(z, columns, variances, per_block)
    found = [
        WeatherGain(float(g), float(s), noise.fast, noise.white, lag_s, noise.coloured)
        for g, s, noise, (_, lag_s) in zip(gains, sigmas, noises, channels, strict=True)
    ]
    rest = z - sum(g * (column - column[0]) for g, column in zip(gains, columns, strict=True))
    return WeatherFit(
        found[0] if record.has_barometer else None,
        found[-1] if record.has_thermometer else None,
        np.asarray(rest, dtype=float),
    )


def _regress_gains(
    z: Series, columns: list[Series], variances: Series, per_block: int
) -> tuple[Series, Series]:
    """Gains and their standard errors, with the best-fitting beta of the noise."""
    used = z.size // per_block * per_block
    blocks = np.array(
        [column[:used].reshape(-1, per_block).mean(axis=1) for column in (z, *columns)]
    )
    moved = np.diff(blocks, axis=1)
    moved -= moved.mean(axis=1, keepdims=True)

    def fit(beta: float) -> tuple[Series, Series, float]:
        white = lfilter([1.0], [1.0, -beta], moved, axis=1)
        target, given = white[0], white[1:]
        normal = given @ given.T
        # a sensor that shows only noise must not make the matrix singular
        noise = np.minimum(2 * variances / (1 + beta) * target.size, 0.9 * np.diag(normal))
        inverse = np.linalg.inv(normal - np.diag(noise))
        gains = inverse @ given @ target
        rest = target - gains @ given
        variance = float(rest @ rest) / (target.size - len(gains) - 1)
        return gains, np.sqrt(np.diag(inverse @ normal @ inverse) * variance), variance

    best = minimize_scalar(
        lambda beta: math.log(fit(beta)[2]), bounds=(0.0, 0.99), method="bounded"
    )
    gains, sigmas, _ = fit(float(best.x))
    return gains, sigmas
