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
# A film pump responds within seconds, and a lag below a tick does not matter.
_LAG_MIN_S = 0.01
_LAG_MAX_S = 2.0
_DEAD_TIME_MAX_S = 3.0
_STARTS_S = (0.03, 0.1, 0.3, 0.6, 1.0, 1.6)
_LAG_START_S = 0.1
_BETA_START = 0.95
_GAMMA_MIN = 0.9
_GAMMA_START = 0.99
_PRESSURE_START_UM_PER_PA = -0.3  # higher pressure outside pushes the film in
# Tolerances of the search: a thousandth of a standard error.
_STEP_TOLERANCE = 1e-5
_COST_TOLERANCE = 1e-7
# Usual changes of gain, dead time (s), lag (s), leak (µm/s), beta, gamma; and of the pressure's
# gain.
_SCALES = (0.1, 0.05, 0.05, 0.1, 0.02, 0.01)
_PRESSURE_SCALE = 0.1
_MEDIAN_OF_GAUSSIAN = 0.6745  # median of |x| in standard deviations


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """The two zeros of the noise: `beta` is near 1 when the laser's noise covers the weather."""

    beta: float
    gamma: float

    def whitened(self, moved_um: Series, dt_s: float) -> Series:
        """Return the prediction errors of the noise model.

        Parameters
        ----------
        moved_um : (n,) array
            Increments of the noise from tick to tick.
        dt_s : float
            Period of a tick.

        Returns
        -------
        (n,) array
            µm; white if the model is right.
        """
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
    """A fitted model and its reliability.

    Attributes
    ----------
    model : PlantModel
        The plant.
    sigma : Sigma
        Standard errors of its parameters.
    covariance : (4, 4) array
        Of gain, dead time, lag and leak.
    noise : NoiseModel
        The zeros that made the prediction errors white.
    pressure_gain_um_per_pa : float
        Effect of the barometer's pressure, 0 without one; a nuisance parameter, which the
        barometer's noise makes too small.
    innovation_um : float
        Standard deviation of the one-step prediction error.
    whiteness_p, independence_p : float
        Probability of residuals at least as coloured, and as correlated with past flow, if the
        model were true.
    largest_residual : float
        In standard deviations.
    residual_um : (n,) array
        Prediction errors.
    """

    model: plant_model.PlantModel
    sigma: Sigma
    covariance: Series
    noise: NoiseModel
    pressure_gain_um_per_pa: float
    innovation_um: float
    whiteness_p: float
    independence_p: float
    largest_residual: float
    residual_um: Series


def compute_prediction_errors(
    record: Record,
    model: plant_model.PlantModel,
    noise: NoiseModel,
    pressure_gain_um_per_pa: float = 0.0,
) -> Series:
    """Compute one-step prediction errors of a model on a record.

    Parameters
    ----------
    record : Record
        n samples.
    model : PlantModel
        The plant.
    noise : NoiseModel
        Makes the errors white if it is right.
    pressure_gain_um_per_pa : float
        The barometer's effect on the centre; 0 omits it.

    Returns
    -------
    (n - 1,) array
        In µm; the first ones include the filter's start-up.
    """
    x = plant_model.compute_driven_um(
        record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s
    )

    # Increments of n: of the reading, less those that pump, leak and pressure explain.
    read = np.diff(record.filled_displacement_um())
    driven = model.gain * np.diff(x)
    leaked_um = model.leak_um_per_s * record.dt_s
    moved = read - driven + leaked_um
    if pressure_gain_um_per_pa != 0.0:
        moved -= pressure_gain_um_per_pa * np.diff(record.ambient_pressure_pa)
    return noise.whitened(moved, record.dt_s)


def identify_plant(record: Record) -> Identified:
    """Fit the model; a barometer, if present, explains part of the noise.

    Parameters
    ----------
    record : Record
        Experiments in which the flow changed.

    Returns
    -------
    Identified

    Raises
    ------
    ValueError
        The record is too short, has no reading, or the flow never changed.
    """
    if len(record) < 10 * LAGS:
        raise ValueError(f"{record.duration_s:.1f} s is too short for an identification")
    if np.ptp(record.flow_um_per_s) <= 0:
        raise ValueError("the flow never changed: repeat `tune characterise`")

    def compute_errors(q: Series) -> Series:
        """Prediction errors for gain, dead time, lag, leak, beta, gamma and the pressure's gain."""
        model = plant_model.PlantModel(q[0], q[1], q[2], q[3])
        noise = NoiseModel(q[4], q[5])
        pressure_gain = 0.0
        if q.size > 6:
            pressure_gain = q[6]
        return compute_prediction_errors(record, model, noise, pressure_gain)

    best = _best_fit(compute_errors, record)
    q = best.x
    gain, dead_time_s, lag_s, leak_um_per_s, beta, gamma, *pressure_gains = q.tolist()
    residual = compute_errors(q)
    innovation_um = float(np.sqrt(np.sum(residual**2) / (residual.size - q.size)))

    # Covariance from the gradient of the errors (Ljung, section 9.4). The model does not resolve
    # times within a sample, and with little noise the fit would claim a dead time more precise than
    # a sample allows.
    covariance = innovation_um**2 * np.linalg.pinv(best.jac.T @ best.jac)
    covariance[1, 1] += record.dt_s**2 / 12

    size = np.abs(residual)
    largest_residual = float(np.max(size) / np.median(size) * _MEDIAN_OF_GAUSSIAN)
    pressure_gain_um_per_pa = 0.0
    if pressure_gains:
        pressure_gain_um_per_pa = pressure_gains[0]
    return Identified(
        model=plant_model.PlantModel(gain, dead_time_s, lag_s, leak_um_per_s),
        sigma=_make_sigma(covariance),
        covariance=covariance[:4, :4],
        noise=NoiseModel(beta, gamma),
        pressure_gain_um_per_pa=pressure_gain_um_per_pa,
        innovation_um=innovation_um,
        whiteness_p=compute_whiteness_p(residual, fitted=2),
        independence_p=compute_independence_p(residual, np.diff(record.flow_um_per_s)),
        largest_residual=largest_residual,
        residual_um=residual,
    )


def _best_fit(compute_errors: Callable[[Series], Series], record: Record) -> OptimizeResult:
    """Least squares from the most promising dead time, as the criterion has several minima."""
    low = [-np.inf, 0.0, _LAG_MIN_S, -np.inf, 0.0, _GAMMA_MIN]
    high = [np.inf, _DEAD_TIME_MAX_S, _LAG_MAX_S, np.inf, _BETA_MAX, _BETA_MAX]
    scales = list(_SCALES)

    # One more unknown if a barometer shows changes.
    pressure_start: list[float] = []
    if record.has_barometer and np.ptp(record.ambient_pressure_pa) > 0:
        pressure_start = [_PRESSURE_START_UM_PER_PA]
        low.append(-np.inf)
        high.append(np.inf)
        scales.append(_PRESSURE_SCALE)

    starts = [_find_start(record, dead_time_s, pressure_start) for dead_time_s in _STARTS_S]
    best_start = min(starts, key=lambda start: float(np.sum(compute_errors(start) ** 2)))
    return least_squares(
        compute_errors,
        best_start,
        bounds=(low, high),
        xtol=_STEP_TOLERANCE,
        ftol=_COST_TOLERANCE,
        x_scale=np.array(scales),
    )


def _find_start(record: Record, dead_time_s: float, pressure_start: list[float]) -> Series:
    """Best gain and leak for a dead time, by linear least squares on the prefiltered record."""
    driven_um = plant_model.compute_driven_um(
        record.flow_um_per_s, dead_time_s, _LAG_START_S, record.dt_s
    )
    by_gain = np.diff(driven_um)
    by_leak = np.full(by_gain.size, -record.dt_s)
    moved = np.diff(record.filled_displacement_um())
    columns = lfilter([1.0], [1.0, -_BETA_START], np.array([by_gain, by_leak, moved]), axis=1)
    gain, leak = np.linalg.lstsq(columns[:2].T, columns[2], rcond=None)[0]
    noise_start = (_BETA_START, _GAMMA_START)
    return np.array([gain, dead_time_s, _LAG_START_S, leak, *noise_start, *pressure_start])


def _make_sigma(covariance: Series) -> Sigma:
    """Standard errors from the covariance of gain, dead time, lag, leak (and others)."""
    # The delay is dead time plus lag.
    delay_variance = covariance[1, 1] + covariance[2, 2] + 2 * covariance[1, 2]
    variances = [*np.diag(covariance)[:4], delay_variance]
    gain, dead_time, lag, leak, delay = np.sqrt(np.maximum(variances, 0.0)).tolist()
    return Sigma(gain, dead_time, lag, delay, leak)
