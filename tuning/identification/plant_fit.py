"""Gain and dead time from a record, by prediction error with a noise model.

The reading is y = k x - leak t + g_p p + n, with x the path of a mirror of gain 1 (`driven_um`).
Weather wanders and the laser is noisy: n is a random walk plus white noise, which is an IMA(1,1)
process

    n[i] - n[i-1] = (1 - beta B) e[i],    e white, B one sample back.

Weather that reaches the gas through the film (air temperature, 12 s) is a walk with its own memory.
Omitting it makes k too small where the flow responds to the readings (by 3 % in gusty weather): so
the increments get a pole,

    n[i] - n[i-1] = (1 - beta B) (1 - gamma B) / (1 - phi B) e[i],    phi = exp(-dt / 12 s),

which is IMA(1,1) for gamma = phi. Minimising the sum of e^2 over (k, leak, theta, T, beta, gamma)
weights the record by its disturbance. Plain output error assumes white n and is biased; the
describing function of a relay uses only one frequency.
Source: Ljung, System Identification (1999), sections 7.2 and 9.4 (covariance from the gradient of
e).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.signal import lfilter

from tuning.identification import plant_model
from tuning.identification.record import Record, Series
from tuning.identification.residual_tests import LAGS, compute_independence_p, compute_whiteness_p

_FILM_S = 12.0  # lag of the gas behind the air (estimate; a factor of 2 does not matter)
_BETA_MAX = 0.9999  # 1 would mean a reading without disturbance
# a film pump responds within seconds, and a lag below a tick does not matter
_LAG_MIN_S = 0.01
_LAG_MAX_S = 2.0
_DEAD_TIME_MAX_S = 3.0
_STARTS_S = (0.03, 0.1, 0.3, 0.6, 1.0, 1.6)
_LAG_START_S = 0.1
_BETA_START = 0.95
_GAMMA_MIN = 0.9
_GAMMA_START = 0.99


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """The two zeros of the noise: `beta` is near 1 when the laser's noise covers the weather."""

    beta: float
    gamma: float

    def whitened(self, moved_um: Series, dt_s: float) -> Series:
        """Prediction errors from the increments of the noise."""
        phi = math.exp(-dt_s / _FILM_S)
        zeros = [1.0, -(self.beta + self.gamma), self.beta * self.gamma]
        return np.asarray(lfilter([1.0, -phi], zeros, moved_um), dtype=float)


@dataclass(frozen=True, slots=True)
class Sigma:
    """Standard errors of the identified parameters."""

    gain: float
    dead_time_s: float
    lag_s: float
    delay_s: float
    leak_um_per_s: float


@dataclass(frozen=True, slots=True)
class Identified:
    """A fitted model and its reliability."""

    model: plant_model.PlantModel
    sigma: Sigma  # standard errors
    covariance: Series  # (4, 4): of gain, dead time, lag, leak
    noise: NoiseModel
    # Of the barometer, 0 without one; a nuisance parameter, biased low by the barometer's noise
    pressure_gain_um_per_pa: float
    innovation_um: float  # standard deviation of the one-step prediction error
    # Probability of residuals at least as coloured, and as correlated with past flow, if the model
    # were true
    whiteness_p: float
    independence_p: float
    largest_residual: float  # in standard deviations
    residual_um: Series  # (n,): prediction errors


def compute_prediction_errors(
    record: Record,
    model: plant_model.PlantModel,
    noise: NoiseModel,
    pressure_gain_um_per_pa: float = 0.0,
) -> Series:
    """One-step prediction errors of a model on a record, (n - 1,) µm; the first ones include the
    filter's start-up.

    `pressure_gain_um_per_pa` is the barometer's effect on the centre; 0 omits it.
    """
    x = plant_model.compute_driven_um(
        record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s
    )
    moved = (
        np.diff(record.filled_displacement_um())
        - model.gain * np.diff(x)
        + model.leak_um_per_s * record.dt_s
    )
    if pressure_gain_um_per_pa != 0.0:
        moved -= pressure_gain_um_per_pa * np.diff(record.ambient_pressure_pa)
    return noise.whitened(moved, record.dt_s)


def identify_plant(record: Record) -> Identified:
    """Fit the model; a barometer, if present, explains part of the noise.

    Raises ValueError if the record is too short, has no reading, or the flow never changed.
    """
    if len(record) < 10 * LAGS:
        raise ValueError(f"{record.duration_s:.1f} s is too short for an identification")
    if np.ptp(record.flow_um_per_s) <= 0:
        raise ValueError("the flow never changed: repeat `tune characterise`")

    def errors(q: Series) -> Series:
        model = plant_model.PlantModel(q[0], q[1], q[2], q[3])
        return compute_prediction_errors(
            record, model, NoiseModel(q[4], q[5]), q[6] if q.size > 6 else 0.0
        )

    best = _best_fit(errors, record)
    q = best.x
    residual = errors(q)
    innovation_um = float(np.sqrt(np.sum(residual**2) / (residual.size - q.size)))
    covariance = innovation_um**2 * np.linalg.pinv(best.jac.T @ best.jac)
    # The model does not resolve times within a sample, and with little noise the fit would claim a
    # dead time more precise than a sample allows.
    covariance[1, 1] += record.dt_s**2 / 12
    return Identified(
        model=plant_model.PlantModel(*(float(v) for v in q[:4])),
        sigma=_make_sigma(covariance),
        covariance=covariance[:4, :4],
        noise=NoiseModel(float(q[4]), float(q[5])),
        pressure_gain_um_per_pa=float(q[6]) if q.size > 6 else 0.0,
        innovation_um=innovation_um,
        whiteness_p=compute_whiteness_p(residual, fitted=2),
        independence_p=compute_independence_p(residual, np.diff(record.flow_um_per_s)),
        largest_residual=float(np.max(np.abs(residual)) / np.median(np.abs(residual)) * 0.6745),
        residual_um=residual,
    )


def _best_fit(errors: Callable[[Series], Series], record: Record) -> OptimizeResult:
    """Least squares from the most promising dead time, as the criterion has several minima."""
    extra = [-0.3] if record.has_barometer and np.ptp(record.ambient_pressure_pa) > 0 else []
    low = [-np.inf, 0.0, _LAG_MIN_S, -np.inf, 0.0, _GAMMA_MIN] + [-np.inf] * len(extra)
    high = [np.inf, _DEAD_TIME_MAX_S, _LAG_MAX_S, np.inf, _BETA_MAX, _BETA_MAX] + [np.inf] * len(
        extra
    )
    starts = [_find_start(record, dead_time_s, extra) for dead_time_s in _STARTS_S]
    return least_squares(
        errors,
        min(starts, key=lambda start: float(np.sum(errors(start) ** 2))),
        bounds=(low, high),
        xtol=1e-5,  # a thousandth of a standard error
        ftol=1e-7,
        x_scale=np.array([0.1, 0.05, 0.05, 0.1, 0.02, 0.01] + [0.1] * len(extra)),
    )


def _find_start(record: Record, dead_time_s: float, extra: list[float]) -> Series:
    """Best gain and leak for a dead time, by linear least squares on the prefiltered record."""
    unit = plant_model.PlantModel(1.0, dead_time_s, _LAG_START_S, 0.0)
    x = np.diff(
        plant_model.compute_driven_um(
            record.flow_um_per_s, unit.dead_time_s, unit.lag_s, record.dt_s
        )
    )
    columns = np.array([x, np.full(x.size, -record.dt_s), np.diff(record.filled_displacement_um())])
    columns = lfilter([1.0], [1.0, -_BETA_START], columns, axis=1)
    gain, leak = np.linalg.lstsq(columns[:2].T, columns[2], rcond=None)[0]
    return np.array([gain, dead_time_s, _LAG_START_S, leak, _BETA_START, _GAMMA_START, *extra])


def _make_sigma(covariance: Series) -> Sigma:
    total = covariance[1, 1] + covariance[2, 2] + 2 * covariance[1, 2]
    gain, dead, lag, leak, delay = np.sqrt(np.maximum([*np.diag(covariance)[:4], total], 0.0))
    return Sigma(float(gain), float(dead), float(lag), float(delay), float(leak))
