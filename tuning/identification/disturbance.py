"""Separates motion of the mirror from noise of the reading: intensities from a quiet hold.

The response to the flow is removed from the readings, z = y - k int v(t - theta) dt, whatever loop
made the flow. The rest is the weather and the laser's noise. Its increments have the spectrum (per
sample, dt S)

    |1 - e^(-j w dt)|^2 (r + sum of s_i / dt / (1 + w^2 tau_i^2)^2)  +  q_fast dt  +  q_slow dt / (1
    + w^2 tau^2)

r: laser noise (µm^2 per sample), q_fast: a random walk (air pressure), q_slow: a random walk that
reaches the gas through the film, tau = 12 s (air temperature), s_i: movement of any other colour,
for weather is no random walk at all frequencies and the standard deviation of a loop depends on
those about its bandwidth. The tau_i stand in equal ratios; log s_i bends little from one to the
next, so that the spectrum goes on as it was where noise hides it. The intensities maximise
Whittle's likelihood, sum of log S + I / S over the periodogram I of the tapered increments, times
that prior.
Source: Percival and Walden, Spectral Analysis for Univariate Time Series (2020), sections 6.3 and
9.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.signal import lfilter
from scipy.signal.windows import hann

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.control.filters import smoothing
from tuning.identification import loop_model
from tuning.identification.loop_model import Record, Series

# Slower motion does not matter to the loop, and weather is no longer a random walk.
SLOWEST_S = 100.0
_FLOOR = 1e-12  # µm^2: stands for a zero intensity
_LARGEST = 1e9  # µm^2/s: the film would burst
_HANN_LOSS = 35.0 / 18.0  # neighbouring frequencies of a Hann taper share this much
_COLOUR_RATIO = 2.0  # of neighbouring tau_i, from the sample time to the slowest
# of first and second differences of log s_i: a spectrum falls with the square of the frequency,
# more or less, and does not bend all at once
_SLOPE_SIGMA, _BEND_SIGMA = 2.0, 1.0
_BAND = 0.03  # frequencies nearer than this factor count as one
_BLOCKS = 10  # of a record, whose variances show how steady the weather is

Coloured = tuple[tuple[float, float], ...]  # (tau in s, s in unit^2 s) of s / (1 + (w tau)^2)^2


def _coloured_psd(coloured: Coloured, w_rad_per_s: Series) -> Series:
    parts = [intensity / (1 + (w_rad_per_s * tau_s) ** 2) ** 2 for tau_s, intensity in coloured]
    return np.sum(parts, axis=0) if parts else np.zeros_like(w_rad_per_s)


@dataclass(frozen=True, slots=True)
class Noise:
    """White noise of a reading, the random walk of its quantity,
    and its movement of other colours.
    """

    white: float  # standard deviation of a sample
    fast: float  # intensities of the walks: variance per second
    slow: float
    slow_s: float  # lag of the slow walk
    dt_s: float  # sample time that `white` belongs to
    coloured: Coloured = ()

    def __post_init__(self) -> None:
        """Raises ValueError for impossible fits, as a file may hold anything."""
        if not all(
            0 <= part <= _LARGEST
            for part in (self.white, self.fast, self.slow, self.slow_s, self.dt_s)
        ):
            raise ValueError(
                f"noise of {self.white:g} and walks of {self.fast:g} and {self.slow:g}"
            )
        if not all(
            0 < tau_s <= _LARGEST and 0 <= part <= _LARGEST for tau_s, part in self.coloured
        ):
            raise ValueError(f"movement of {self.coloured}")

    def moving_psd(self, w_rad_per_s: Series) -> Series:
        """Two-sided spectrum of the true movement, unit^2 s."""
        walks = (self.fast + self.slow / (1 + (w_rad_per_s * self.slow_s) ** 2)) / w_rad_per_s**2
        return walks + _coloured_psd(self.coloured, w_rad_per_s)

    @property
    def white_psd(self) -> float:
        """Two-sided spectrum of the reading's noise, unit^2 s."""
        return self.white**2 * self.dt_s


def undriven_um(record: Record, model: loop_model.PlantModel) -> Series:
    """z: the readings without the effect of pump and mean leak, (n,) µm."""
    driven = loop_model.driven_um(record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s)
    return record.filled_displacement_um() - model.gain * driven


def fit_noise(series: Series, dt_s: float, slow_s: float) -> Noise:
    """Fit the intensities of white noise and movement in a series; a straight trend has no effect.

    Raises ValueError if the series is shorter than two of the slowest periods used. `slow_s` is the
    lag of the slow walk; 0 omits it.
    """
    if series.size * dt_s < 2 * SLOWEST_S:
        raise ValueError(
            f"{series.size * dt_s:.0f} s of hold are too short: {2 * SLOWEST_S:.0f} s at least"
        )
    w, power, count = _periodogram(np.diff(series), dt_s)
    white = np.abs(1 - np.exp(-1j * w * dt_s)) ** 2
    walks = [np.full(w.size, dt_s), *([dt_s / (1 + (w * slow_s) ** 2)] if slow_s > 0 else [])]
    slowest_s = SLOWEST_S / (2 * math.pi)
    taus_s = np.geomspace(dt_s, slowest_s, 1 + round(math.log(slowest_s / dt_s, _COLOUR_RATIO)))
    first = 1 + len(walks)
    basis = np.array(
        [white, *walks, *(white / dt_s / (1 + (w * tau_s) ** 2) ** 2 for tau_s in taus_s)]
    )
    likely, usual = _prior(taus_s, first)
    walk = float(np.mean(power[:8])) / dt_s
    guess = [
        float(power @ count / count.sum()) / 2,
        *[walk] * len(walks),
        *(walk * taus_s**2 / taus_s.size),
    ]
    intensities = np.exp(_likeliest(basis, power, count, likely, usual, np.log(guess)))
    fast, slow = (*intensities[1:first].tolist(), 0.0)[:2]
    coloured = tuple(zip(taus_s.tolist(), intensities[first:].tolist(), strict=True))
    return Noise(math.sqrt(intensities[0]), fast, slow, slow_s, dt_s, coloured)


def _prior(taus_s: Series, first: int) -> tuple[Series, Series]:
    """Rows R and values r: R x logs - r are independent and of unit variance; `first` logs are
    free.
    """
    one = np.eye(taus_s.size)
    rows = np.vstack((np.diff(one, 2, axis=0) / _BEND_SIGMA, np.diff(one, axis=0) / _SLOPE_SIGMA))
    return np.hstack((np.zeros((len(rows), first)), rows)), rows @ (2 * np.log(taus_s))


def _likeliest(
    basis: Series, power: Series, count: Series, likely: Series, usual: Series, start: Series
) -> Series:
    """Logarithms of the intensities; Whittle's likelihood with its information matrix."""

    def cost(logs: Series) -> tuple[float, Series]:
        spectrum = np.exp(logs) @ basis
        off = likely @ logs - usual
        slope = _shares(logs, basis) @ (count * (1 - power / spectrum)) + likely.T @ off
        return float(count @ (np.log(spectrum) + power / spectrum) + off @ off / 2), slope

    def information(logs: Series) -> Series:
        shares = _shares(logs, basis)
        return np.asarray(shares * count @ shares.T + likely.T @ likely)

    found = minimize(
        cost,
        start,
        jac=True,
        hess=information,
        method="trust-exact",
        options={"gtol": 1e-2, "maxiter": 200},
    ).x
    return np.asarray(np.maximum(found, math.log(_FLOOR)), dtype=float)


def _shares(logs: Series, basis: Series) -> Series:
    parts = np.exp(logs)[:, None] * basis
    return np.asarray(parts / parts.sum(axis=0))


def _periodogram(increments: Series, dt_s: float) -> tuple[Series, Series, Series]:
    """Angular frequencies from the slowest that matters to Nyquist, tapered power per sample,
    independent ones.
    """
    taper = hann(increments.size, sym=False)
    taper /= math.sqrt(float(taper @ taper))
    power = np.abs(np.fft.rfft((increments - increments.mean()) * taper)) ** 2
    w = 2 * np.pi * np.fft.rfftfreq(increments.size, dt_s)
    used = slice(int(np.searchsorted(w, 2 * np.pi / SLOWEST_S)), w.size - 1)
    w, power = w[used], power[used]
    band = np.unique(np.floor(np.log(w / w[0]) / _BAND), return_inverse=True)[1]
    count = np.bincount(band)
    return np.bincount(band, w) / count, np.bincount(band, power) / count, count / _HANN_LOSS


# Gains of the weather on the centre: regression of the undriven readings on barometer and lagged
# air temperature.
#
#     z = c t + g_p p + g_T lag(T_air) + n,    n = IMA(1,1)
#
# All columns are differenced and prewhitened with 1 / (1 - beta B), on means over blocks. A noisy
# sensor makes its gain too small (errors in variables): white noise of variance r has the variance
# 2 r / (1 + beta) after the filter, which is taken off the diagonal of the normal equations.
# Source: Fuller, Measurement Error Models (1987), section 2.2.

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
        return self.walk / w_rad_per_s**2 + _coloured_psd(self.coloured, w_rad_per_s)

    def agreed(self, configured: float) -> float:
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


def lagged(series: Series, lag_s: float, dt_s: float) -> Series:
    """First-order lag that starts at its first input."""
    share = smoothing(dt_s, lag_s)
    followed = np.asarray(lfilter([share], [1.0, share - 1.0], series - series[0]), dtype=float)
    return followed + float(series[0])


def fit_weather(
    record: Record, model: loop_model.PlantModel, gas_follows_air_s: float
) -> WeatherFit:
    """Regress the motion not caused by the pump on the weather.

    `record` is a quiet hold of some minutes, `gas_follows_air_s` the lag of the gas behind the air.
    """
    z = undriven_um(record, model)
    channels: list[tuple[Series, float]] = []
    if record.has_barometer:
        channels.append((record.ambient_pressure_pa, 0.0))
    if record.has_thermometer:
        channels.append((record.air_temperature_c, gas_follows_air_s))
    if not channels:
        return WeatherFit(None, None, z)
    noises = [fit_noise(series, record.dt_s, 0.0) for series, _ in channels]
    columns = [lagged(series, lag_s, record.dt_s) for series, lag_s in channels]
    # of a lagged sensor's noise only dt / (2 T) of the variance passes the lag
    shares = [1.0 if lag_s == 0 else record.dt_s / (2 * lag_s) for _, lag_s in channels]
    per_block = max(1, round(_BLOCK_S / record.dt_s))
    variances = np.array(
        [n.white**2 * share / per_block for n, share in zip(noises, shares, strict=True)]
    )
    gains, sigmas = _regress(z, columns, variances, per_block)
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


def _regress(
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


# All disturbances of the mirror, as spectra: explained by the weather sensors, and not.


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

    def psd(self, w_rad_per_s: Series, model: loop_model.PlantModel, loop: LoopConfig) -> Series:
        """Two-sided spectrum of the centre without feedback but with the loop's feed-forward, µm^2
        s.

        The feed-forward takes a channel's movement x away as far as the pump is in time: x (1 - H),
        with H the pump behind the feed-forward's filter; the sensor's noise comes in through H.
        """
        dt_s = self.rest.dt_s
        pump = loop_model.pump_response(model, w_rad_per_s, dt_s)
        total = self.rest.moving_psd(w_rad_per_s)
        for weather, used, gain, filter_s in self._channels(loop):
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
        for weather, used, gain, filter_s in self._channels(loop):
            rate = gain * w_rad_per_s / np.abs(1 + 1j * w_rad_per_s * filter_s) if used else 0.0
            total = total + rate**2 * (weather.psd(w_rad_per_s) + weather.noise**2 * self.rest.dt_s)
        return total

    def _channels(self, loop: LoopConfig) -> list[tuple[WeatherGain, bool, float, float]]:
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


def observe(record: Record, model: loop_model.PlantModel, loop: LoopConfig) -> DisturbanceModel:
    """Weather gains and noise from a quiet hold under any loop. Raises ValueError if it is too
    short.
    """
    weather = fit_weather(record, model, loop.gas_follows_air_s)
    rest = fit_noise(weather.rest_um, record.dt_s, loop.gas_follows_air_s)
    found = DisturbanceModel(rest, weather.barometer, weather.air)
    return replace(found, unsteady=_unsteady(record.filled_displacement_um(), found, model, loop))


def _unsteady(
    read_um: Series, found: DisturbanceModel, model: loop_model.PlantModel, loop: LoopConfig
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
    return float(variances.std(ddof=1) / max(variances.mean(), _FLOOR) / 2 * math.sqrt(2 / _BLOCKS))
