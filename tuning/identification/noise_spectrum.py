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
next, so that the spectrum continues where noise hides it. The intensities maximise
Whittle's likelihood, sum of log S + I / S over the periodogram I of the tapered increments, times
that prior.
Source: Percival and Walden, Spectral Analysis for Univariate Time Series (2020), sections 6.3 and
9.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.signal.windows import hann

from tuning.identification import plant_model
from tuning.identification.record import Record, Series

# Slower motion does not matter to the loop, and weather is no longer a random walk.
SLOWEST_S = 100.0
FLOOR = 1e-12  # µm^2: stands for a zero intensity
_LARGEST = 1e9  # µm^2/s: the film would burst
_HANN_LOSS = 35.0 / 18.0  # neighbouring frequencies of a Hann taper share this much
_COLOUR_RATIO = 2.0  # of neighbouring tau_i, from the sample time to the slowest
# of first and second differences of log s_i: a spectrum falls with the square of the frequency,
# more or less, and does not bend all at once
_SLOPE_SIGMA = 2.0
_BEND_SIGMA = 1.0
_BAND = 0.03  # frequencies nearer than this factor count as one
Coloured = tuple[tuple[float, float], ...]  # (tau in s, s in unit^2 s) of s / (1 + (w tau)^2)^2


def compute_coloured_psd(coloured: Coloured, w_rad_per_s: Series) -> Series:
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
        return walks + compute_coloured_psd(self.coloured, w_rad_per_s)

    @property
    def white_psd(self) -> float:
        """Two-sided spectrum of the reading's noise, unit^2 s."""
        return self.white**2 * self.dt_s


def remove_pump_motion_um(record: Record, model: plant_model.PlantModel) -> Series:
    """z: the readings without the effect of pump and mean leak, (n,) µm."""
    driven = plant_model.compute_driven_um(
        record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s
    )
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
    w, power, count = _compute_periodogram(np.diff(series), dt_s)
    white = np.abs(1 - np.exp(-1j * w * dt_s)) ** 2
    walks = [np.full(w.size, dt_s), *([dt_s / (1 + (w * slow_s) ** 2)] if slow_s > 0 else [])]
    slowest_s = SLOWEST_S / (2 * math.pi)
    taus_s = np.geomspace(dt_s, slowest_s, 1 + round(math.log(slowest_s / dt_s, _COLOUR_RATIO)))
    first = 1 + len(walks)
    basis = np.array(
        [white, *walks, *(white / dt_s / (1 + (w * tau_s) ** 2) ** 2 for tau_s in taus_s)]
    )
    likely, usual = _make_prior(taus_s, first)
    walk = float(np.mean(power[:8])) / dt_s
    guess = [
        float(power @ count / count.sum()) / 2,
        *[walk] * len(walks),
        *(walk * taus_s**2 / taus_s.size),
    ]
    intensities = np.exp(_maximise_likelihood(basis, power, count, likely, usual, np.log(guess)))
    fast, slow = (*intensities[1:first].tolist(), 0.0)[:2]
    coloured = tuple(zip(taus_s.tolist(), intensities[first:].tolist(), strict=True))
    return Noise(math.sqrt(intensities[0]), fast, slow, slow_s, dt_s, coloured)


def _make_prior(taus_s: Series, first: int) -> tuple[Series, Series]:
    """Rows R and values r: R x logs - r are independent and of unit variance; `first` logs are
    free.
    """
    one = np.eye(taus_s.size)
    rows = np.vstack((np.diff(one, 2, axis=0) / _BEND_SIGMA, np.diff(one, axis=0) / _SLOPE_SIGMA))
    return np.hstack((np.zeros((len(rows), first)), rows)), rows @ (2 * np.log(taus_s))


def _maximise_likelihood(
    basis: Series, power: Series, count: Series, likely: Series, usual: Series, start: Series
) -> Series:
    """Logarithms of the intensities; Whittle's likelihood with its information matrix."""

    def cost(logs: Series) -> tuple[float, Series]:
        spectrum = np.exp(logs) @ basis
        off = likely @ logs - usual
        slope = _compute_shares(logs, basis) @ (count * (1 - power / spectrum)) + likely.T @ off
        return float(count @ (np.log(spectrum) + power / spectrum) + off @ off / 2), slope

    def information(logs: Series) -> Series:
        shares = _compute_shares(logs, basis)
        return np.asarray(shares * count @ shares.T + likely.T @ likely)

    found = minimize(
        cost,
        start,
        jac=True,
        hess=information,
        method="trust-exact",
        options={"gtol": 1e-2, "maxiter": 200},
    ).x
    return np.asarray(np.maximum(found, math.log(FLOOR)), dtype=float)


def _compute_shares(logs: Series, basis: Series) -> Series:
    parts = np.exp(logs)[:, None] * basis
    return np.asarray(parts / parts.sum(axis=0))


def _compute_periodogram(increments: Series, dt_s: float) -> tuple[Series, Series, Series]:
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
