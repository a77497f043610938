"""What moves the mirror and what only moves the reading: intensities from a quiet hold.

The flow's share is taken out of the readings, z = y - k int v(t - theta) dt, whatever loop made the flow. What is
left is the weather and the laser's noise. Its increments have the spectrum (per sample, dt S)

    |1 - e^(-j w dt)|^2 r  +  q_fast dt  +  q_slow dt / (1 + w^2 tau^2)

r: laser noise (um^2 a sample), q_fast: a random walk (air pressure), q_slow: a random walk that reaches the gas
through the film, tau = 12 s (air temperature). Without the last term this is the IMA(1,1) process. The
intensities maximise Whittle's likelihood, sum of log S + I / S over the periodogram I of the tapered increments.
Source: Percival and Walden, Spectral Analysis for Univariate Time Series (2020), sections 6.3 and 9.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.signal.windows import hann

from tuning.plant_model import PlantModel, driven_um
from tuning.records import Record, Series

# Slower than this the loop does not care, and a random walk is no longer what weather does.
_SLOWEST_S = 100.0
_FLOOR = 1e-12  # um^2: an intensity that is not there
_HANN_LOSS = 35.0 / 18.0  # neighbouring frequencies of a Hann taper share this much


@dataclass(frozen=True, slots=True)
class Noise:
    """White noise on a reading and the walk of what it reads.

    Attributes
    ----------
    white : float
        Standard deviation of a sample.
    fast, slow : float
        Intensities of the walks: variance per second.
    slow_s : float
        Lag behind which the slow walk comes.
    white_sigma, fast_sigma, slow_sigma : float
        Relative standard errors of the variance of each.
    dt_s : float
        Sample time that `white` belongs to.
    """

    white: float
    fast: float
    slow: float
    slow_s: float
    white_sigma: float
    fast_sigma: float
    slow_sigma: float
    dt_s: float

    def moving_psd(self, w_rad_per_s: Series) -> Series:
        """Two-sided spectrum of the true movement, unit^2 s."""
        return (self.fast + self.slow / (1 + (w_rad_per_s * self.slow_s) ** 2)) / w_rad_per_s**2

    @property
    def white_psd(self) -> float:
        """Two-sided spectrum of the reading's noise, unit^2 s."""
        return self.white**2 * self.dt_s


def undriven_um(record: Record, model: PlantModel) -> Series:
    """z: the readings without what the pump and the mean leak did, (n,) um."""
    driven = driven_um(record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s)
    return record.filled_displacement_um() - model.gain * driven


def fit_noise(series: Series, dt_s: float, slow_s: float) -> Noise:
    """Intensities of white noise and walks in a series; a straight trend does not matter.

    Parameters
    ----------
    series : (n,) array
    dt_s : float
    slow_s : float
        Lag of the slow walk; 0 leaves it out.

    Raises
    ------
    ValueError
        If the series is shorter than two of the slowest periods looked at.
    """
    if series.size * dt_s < 2 * _SLOWEST_S:
        raise ValueError(f"{series.size * dt_s:.0f} s of hold are too short: {2 * _SLOWEST_S:.0f} s at least")
    w, power = _periodogram(np.diff(series), dt_s)
    shapes = [np.abs(1 - np.exp(-1j * w * dt_s)) ** 2, np.full(w.size, dt_s)]
    if slow_s > 0:
        shapes.append(dt_s / (1 + (w * slow_s) ** 2))
    basis = np.array(shapes)

    def cost(logs: Series) -> tuple[float, Series]:
        parts = (np.exp(logs) + _FLOOR)[:, None] * basis
        spectrum = parts.sum(axis=0)
        slope = parts / spectrum * (1 - power / spectrum)
        return float(np.sum(np.log(spectrum) + power / spectrum)), slope.sum(axis=1)

    fast_guess = float(np.mean(power[: max(8, w.size // 1000)])) / dt_s
    start = np.log(np.array([float(np.mean(power)) / 2, fast_guess, fast_guess][: len(basis)]))
    fit = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=[(math.log(_FLOOR), 20.0)] * len(basis))
    intensities = np.exp(fit.x)
    shares = intensities[:, None] * basis / (intensities @ basis)
    errors = np.sqrt(np.diag(np.linalg.pinv(shares @ shares.T)) * _HANN_LOSS)
    white, fast, slow = (*intensities, 0.0, 0.0)[:3]
    white_error, fast_error, slow_error = (*errors, 0.0, 0.0)[:3]
    return Noise(
        math.sqrt(white),
        float(fast),
        float(slow),
        slow_s,
        float(white_error),
        float(fast_error),
        float(slow_error),
        dt_s,
    )


def _periodogram(increments: Series, dt_s: float) -> tuple[Series, Series]:
    """Angular frequencies from the slowest that matters to Nyquist, and tapered power a sample."""
    taper = hann(increments.size, sym=False)
    taper /= math.sqrt(float(taper @ taper))
    power = np.abs(np.fft.rfft((increments - increments.mean()) * taper)) ** 2
    w = 2 * np.pi * np.fft.rfftfreq(increments.size, dt_s)
    used = slice(int(np.searchsorted(w, 2 * np.pi / _SLOWEST_S)), w.size - 1)
    return np.asarray(w[used], dtype=float), np.asarray(power[used], dtype=float)
