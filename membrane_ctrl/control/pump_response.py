"""Identifies the pump's dead time and lag from the mirror's motion while the pump switches on and
off. Pure.

    y = y_0 + v t + k x(t; d, L) + walk + noise                                             (1)

x is the path of a mirror of gain 1 behind a dead time d and a lag L. Only two commands occur, so
the pump's curve has no effect: the flow k between them is an unknown. The speed v with the pump off
is known within its standard deviation, and k within 60 % of the configured curve. y_0 and k are
eliminated, d and L are averaged over a grid by their probability. Their prior is wide, about a
typical pump: where the readings show little, the error bars show it. As both are positive, their
probability narrows where the readings make them too small; the standard deviation of their sum is
therefore at least that of a shift in time, which the readings show equally well everywhere.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import EstimatorConfig
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.state_tree import StateNode

# Readings are averaged in so many intervals: the time of a tick stays below a millisecond.
_INTERVALS_MOST = 40
# Motion of the centre by the weather of a room.
_WALK_UM_PER_ROOT_S = 0.1
_FLOW_SIGMA_SHARE = 0.6
# Prior of d + L: the median of small pumps, and a factor of 5 at one standard deviation.
_MEDIAN_S = 0.25
_PRIOR_LOG_SIGMA = math.log(5.0)
# First grid: d + L, and the share of the dead time in it
_SUM_S = np.geomspace(0.03, 8.0, 20)
_DELAY_SHARES = np.array([0.05, 0.275, 0.5, 0.725, 0.95])
_SUM_STEP = _SUM_S[1] / _SUM_S[0] - 1.0
_SHARE_STEP = _DELAY_SHARES[1] - _DELAY_SHARES[0]
# Second grid, about the result of the first
_FINE_SUMS = 13
_FINE_SHARES = 9
_READINGS_LEAST = 10
# For the derivative of a path
_SHIFT_S = 0.01
# Beyond this reduced chi-square something else than the pump moved the readings.
_CHI2_MOST = 9.0


@dataclass(frozen=True, slots=True)
class PumpResponse(StateNode):
    """An identified response.

    Attributes
    ----------
    delay_s, lag_s : float
        Dead time from command to gas, and time constant.
    delay_sigma_s, lag_sigma_s, sum_sigma_s : float
        Standard deviations of both and of their sum, which readings show best.
    """

    delay_s: float
    lag_s: float
    delay_sigma_s: float
    lag_sigma_s: float
    sum_sigma_s: float

    @property
    def sum_s(self) -> float:
        """Dead time and lag together: by how much a ramp of the flow arrives late."""
        return self.delay_s + self.lag_s


@dataclass(frozen=True, slots=True)
class Switch(StateNode):
    """The pump is switched on or off.

    Attributes
    ----------
    at_s : float
    on : bool
    """

    at_s: float
    on: bool


def identify_pump_response(
    readings: FloatArray,
    switches: Sequence[Switch],
    noise_um: float,
    still_um_per_s: float,
    still_sigma_um_per_s: float,
    flow_um_per_s: float,
) -> PumpResponse | None:
    """Identify the response from readings during a pattern of on and off.

    Parameters
    ----------
    readings : (n, 2) array
        Time in s and displacement in µm; none before the first switch.
    switches : sequence of Switch
        In order of time; the pump was off before the first one.
    noise_um : float
        Standard deviation of a reading.
    still_um_per_s, still_sigma_um_per_s : float
        Speed of the mirror with the pump off, and its standard deviation.
    flow_um_per_s : float
        Flow of the pump when it is on, by its configured curve.

    Returns
    -------
    PumpResponse or None
        None without enough readings, or if they do not follow (1).
    """
    if len(readings) < _READINGS_LEAST or len(switches) < 2:
        return None
    time_s, height_um, counts = _average_readings(readings)
    # The covariance of the means: noise of readings, and a random walk since the first of them
    walk_um2 = _WALK_UM_PER_ROOT_S**2 * np.minimum.outer(time_s - time_s[0], time_s - time_s[0])
    # and the error of the speed with the pump off
    since_s = time_s - time_s.mean()
    speed_um2 = still_sigma_um_per_s**2 * np.outer(since_s, since_s)
    covariance_um2 = walk_um2 + speed_um2 + np.diag(noise_um**2 / counts)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance_um2))
    # y_0 is eliminated: project on what a constant cannot explain
    constant = whiten.sum(axis=1)
    project = whiten - np.outer(constant, constant @ whiten) / float(constant @ constant)
    seen = project @ (height_um - still_um_per_s * since_s)
    freedom = len(time_s) - 4  # y_0, k, d, L
    flow_weight = (_FLOW_SIGMA_SHARE * flow_um_per_s) ** -2
    sums_s, shares = _SUM_S, _DELAY_SHARES
    for rounds_left in (1, 0):
        sum_s, share = (grid.ravel() for grid in np.meshgrid(sums_s, shares, indexing="ij"))
        delay_s, lag_s = share * sum_s, (1.0 - share) * sum_s
        paths = project @ _simulate_paths(time_s, switches, delay_s, lag_s)
        # Chi-square with the most probable flow k at each point of the grid
        overlap = seen @ paths + flow_um_per_s * flow_weight
        curvature = (paths**2).sum(axis=0) + flow_weight
        chi2 = float(seen @ seen) + flow_um_per_s**2 * flow_weight - overlap**2 / curvature
        reduced = max(1.0, float(chi2.min()) / freedom)
        if reduced > _CHI2_MOST:
            return None
        log_prior = -0.5 * (np.log(sum_s / _MEDIAN_S) / _PRIOR_LOG_SIGMA) ** 2
        # A flow that the readings fix better leaves less room for it
        log_room = -0.5 * np.log(curvature)
        log_weight = -0.5 * (chi2 - chi2.min()) / reduced + log_room + log_prior
        # Each point of the grid stands for an interval of log (d + L)
        interval = np.repeat(np.gradient(np.log(sums_s)), len(shares))
        weight = np.exp(log_weight - log_weight.max()) * interval
        best = int(weight.argmax())
        if rounds_left:
            sums_s = _refine(sum_s, weight, sum_s[best], _SUM_STEP * sum_s[best], _FINE_SUMS)
            sums_s = np.maximum(sums_s, 1e-3 * np.arange(1, _FINE_SUMS + 1))
            shares = _refine(share, weight, share[best], _SHARE_STEP, _FINE_SHARES)
            shares = np.clip(shares, 0.0, 0.999)
    response = _average_grid(delay_s, lag_s, weight, float(np.diff(sums_s)[-1]))
    # A reading's change by a shift in time, less what another flow would change as well
    later = project @ _simulate_paths(
        time_s, switches, delay_s[best : best + 1] + _SHIFT_S, lag_s[best : best + 1]
    )
    shift = (later[:, 0] - paths[:, best]) / _SHIFT_S
    shift -= paths[:, best] * (paths[:, best] @ shift) / curvature[best]
    slope_per_s = abs(overlap[best] / curvature[best]) * float(np.linalg.norm(shift))
    shift_sigma_s = float(_SUM_S[-1])  # readings that show nothing
    if slope_per_s * shift_sigma_s > math.sqrt(reduced):
        shift_sigma_s = math.sqrt(reduced) / slope_per_s
    return replace(response, sum_sigma_s=max(response.sum_sigma_s, shift_sigma_s))


def estimate_flow(
    readings: FloatArray,
    switches: Sequence[Switch],
    response: PumpResponse,
    still_um_per_s: float,
) -> float:
    """Estimate the pump's flow when it is on: k of (1) by least squares, for a known response.

    Parameters
    ----------
    readings : (n, 2) array
        As in `identify_pump_response`.
    switches : sequence of Switch
        When the pump was switched on and off.
    response : PumpResponse
        Dead time and lag.
    still_um_per_s : float
        Motion of the mirror with the pump off.

    Returns
    -------
    float
        µm/s.
    """
    time_s = readings[:, 0]
    path = _simulate_paths(
        time_s, switches, np.array([response.delay_s]), np.array([response.lag_s])
    )[:, 0]
    height_um = readings[:, 1] - still_um_per_s * time_s
    path = path - path.mean()
    return float(path @ height_um / (path @ path))


def apply_response(estimator: EstimatorConfig, response: PumpResponse | None) -> EstimatorConfig:
    """Return the settings with an identified response, if they do not state one.

    Parameters
    ----------
    estimator : EstimatorConfig
        As configured, with dead time and lag that may only be assumed.
    response : PumpResponse or None
        Found by the test of the actuators; None without one.
    """
    if response is None or estimator.pump_response == "stated":
        return estimator
    return estimator.model_copy(
        update={"pump_delay_s": response.delay_s, "pump_lag_s": response.lag_s}
    )


def _average_readings(readings: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means of time and height over consecutive readings, and the count of readings in each."""
    intervals = min(len(readings), _INTERVALS_MOST)
    shortest, longer = divmod(len(readings), intervals)
    # Of intervals that cannot be equal, the first ones have a reading more
    counts = np.full(intervals, float(shortest))
    counts[:longer] += 1.0
    begins = np.concatenate(([0], np.cumsum(counts[:-1]))).astype(np.int64)
    means = np.add.reduceat(readings, begins, axis=0) / counts[:, None]
    return means[:, 0], means[:, 1], counts


def _simulate_paths(
    time_s: FloatArray, switches: Sequence[Switch], delays_s: FloatArray, lags_s: FloatArray
) -> FloatArray:
    """Path of a mirror of gain 1 for each response, (times, responses)."""
    # The integral of a step behind dead time and lag, t - L (1 - exp(-t / L)), for each switch
    paths = np.zeros((len(time_s), len(delays_s)))
    for number, switch in enumerate(switches):
        sign = 1.0 if switch.on else -1.0
        if number == 0 and not switch.on:
            continue
        since_s = np.maximum(time_s[:, None] - switch.at_s - delays_s, 0.0)
        paths += sign * (since_s + lags_s * np.expm1(-since_s / lags_s))
    return paths


def _average_grid(
    delay_s: FloatArray, lag_s: FloatArray, weight: FloatArray, step_s: float
) -> PumpResponse:
    """Mean and standard deviation over a grid, whose step adds to the latter."""
    weight = weight / weight.sum()

    def sigma_s(value_s: FloatArray) -> float:
        mean_s = float(weight @ value_s)
        return math.sqrt(float(weight @ (value_s - mean_s) ** 2) + step_s**2 / 12.0)

    return PumpResponse(
        delay_s=float(weight @ delay_s),
        lag_s=float(weight @ lag_s),
        delay_sigma_s=sigma_s(delay_s),
        lag_sigma_s=sigma_s(lag_s),
        sum_sigma_s=sigma_s(delay_s + lag_s),
    )


def _refine(
    values: FloatArray, weights: FloatArray, best: float, step: float, count: int
) -> FloatArray:
    """Values of a finer grid, which covers the probable ones and a step about the best."""
    mean = float(weights @ values) / float(weights.sum())
    sigma = math.sqrt(float(weights @ (values - mean) ** 2) / float(weights.sum()))
    low = min(mean - 3.0 * sigma, best - step)
    high = max(mean + 3.0 * sigma, best + step)
    return np.linspace(low, high, count)
