"""Verifies new gains: ten minutes of hold, judged in stages, against the previous gains.

The true centre is unknown, and the laser's noise is ten times its motion. The correlation of
readings over lags of up to a second is nearly all motion; the model gives the loop's response to
noise:

    var x = var x predicted + mean of (cov(y[i], y[i + l]) seen - predicted),  0 < l dt <= 1 s.

The weather of these ten minutes differs from that of the hour before. So the comparison is with the
*old* gains in the same weather: what the pump did not cause in the same record is given to the old
loop, with the limits of its pump (docs/decisions/78-gains-on-trial.md). In the first minutes the
weather of the session is assumed.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.signal import welch

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from tuning.gains_file import GainsFile
from tuning.identification import disturbance, identify, loop_model
from tuning.identification.loop_model import Record, Series
from tuning.proposal.prediction import least_std_um, limited, predict, replayed_um

# Time of a stage, and growth that ends the trial there: early on only plain failures, as a minute
# of weather scatters by a third; at the end the required 10 %.
STAGES = ((60.0, 2.0), (180.0, 1.5), (300.0, 1.3), (600.0, 1.10))
SETTLE_LEAST_S, _SETTLE_MOST_S = 20.0, 120.0
# of the loop's slowest mode: 2 % of the transient from the change of gains is left
_SETTLE_TIME_CONSTANTS = 4.0
MS_MAX = 2.0  # sensitivity seen; its estimate scatters by a tenth
_CLOSE = 1.13  # of the largest growth
_SEGMENT_S = 20.0
# 17 half-overlapping segments: power to a quarter. Before that the session's weather is assumed: a
# plant that has changed would look like weather, in which the old gains do no better
_REPLAY_LEAST_S = 180.0
_OBSERVE_LEAST_S = 300.0  # of a spectrum of the weather
# shorter than the centre's memory (2 s and more), with 50 times as many pairs as one lag
_LAGS_S = 1.0
_POINTS = 3000
_BAND = 1.3  # width of a band in frequency, as a factor


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage's result."""

    time_s: float
    std_um: float  # of the centre, from the record
    before_um: (
        float  # of the old gains: predicted, or after three minutes replayed in this very weather
    )
    growth: float  # ratio of the two
    growth_max: float  # the limit
    ms: float  # sensitivity seen; NaN while the record is too short
    lost_fraction: float  # readings lost
    reason: str  # why it fails; empty if it passes

    @property
    def close(self) -> bool:
        """Whether it fails by less than the standard deviation of ten minutes scatters."""
        return self.growth_max < self.growth < _CLOSE * self.growth_max


def settle_s(loop: LoopConfig) -> float:
    """Settling time of the centre after the change to these gains.

    Without delay and filter the loop around the film's integral is s^2 + K s + K / Ti = 0 (Td is
    small beside both); its slowest root has the real part (K - sqrt(K^2 - 4 K / Ti)) / 2, or K / 2
    where it swings.
    """
    k, ti_s = loop.kp_per_s, loop.ti_s
    slowest_per_s = (k - math.sqrt(max(0.0, k * k - 4 * k / ti_s))) / 2
    slowest_s = 1 / slowest_per_s if slowest_per_s > 0 else math.inf
    return min(max(SETTLE_LEAST_S, _SETTLE_TIME_CONSTANTS * slowest_s), _SETTLE_MOST_S)


@dataclass(frozen=True, slots=True)
class VerificationTrial:
    """The data of the comparison."""

    model: loop_model.PlantModel
    weather: disturbance.DisturbanceModel
    before: LoopConfig
    after: LoopConfig
    # a person chose these gains knowing that a larger deviation is predicted
    accepted: bool = False
    pump: PumpConfig = field(default_factory=PumpConfig)


def centre_std_um(
    off_um: Series,
    trial: VerificationTrial,
    weather: disturbance.DisturbanceModel,
    loop: LoopConfig,
) -> float:
    """Standard deviation of the centre without the laser's noise; 0 if the estimate is negative.

    `off_um` (n,) are readings less setpoint under `loop`; they correct the prediction for this
    weather.
    """
    dt_s = weather.rest.dt_s
    off = off_um - off_um.mean()
    lags = np.arange(1, round(_LAGS_S / dt_s) + 1)
    seen = np.array([off[lag:] @ off[:-lag] / (off.size - lag) for lag in lags])
    gains = loop_model.Gains.of(loop)
    w = loop_model.frequencies(dt_s, _POINTS)
    model, moving = limited(gains, trial.model, weather, loop, w)
    sensitivity = np.abs(1 / (1 + loop_model.loop_response(gains, model, w, dt_s))) ** 2
    noise = weather.rest.white_psd
    coloured = sensitivity * (moving + noise) - noise
    expected = np.trapezoid(coloured * np.cos(np.outer(lags * dt_s, w)), w, axis=1) / np.pi
    predicted_um = predict(gains, trial.model, weather, loop).std_um
    return math.sqrt(max(0.0, predicted_um**2 + float(np.mean(seen - expected))))


def seen_sensitivity(
    off_um: Series, trial: VerificationTrial, weather: disturbance.DisturbanceModel
) -> float:
    """Largest sensitivity, from the excess of the spectrum over the model's prediction.

    Increased gain or delay of the plant shows as a peak near the crossover. The level of the
    weather does not
    matter: only the shape is compared, each band with the median band.
    """
    gains, dt_s = loop_model.Gains.of(trial.after), weather.rest.dt_s
    frequency_hz, power = welch(
        off_um, 1 / dt_s, nperseg=round(_SEGMENT_S / dt_s), detrend="constant"
    )
    w: Series = 2 * np.pi * frequency_hz
    fastest = math.pi / (2 * (trial.model.delay_s + gains.filter_s + dt_s))
    used = (w > 2 * np.pi * 3 / _SEGMENT_S) & (w < 2 * fastest)
    w, power = w[used], power[used]
    model, moving = limited(gains, trial.model, weather, trial.after, w)
    s = np.abs(1 / (1 + loop_model.loop_response(gains, model, w, dt_s))) ** 2
    peak = s >= min(
        1.0, s.max()
    )  # slower motion that exceeds the prediction is weather, or a limit of the pump
    excess, bands = power[peak] / (s * (moving + weather.rest.white_psd))[peak], w[peak]
    bands = np.floor(np.log(bands / w[0]) / math.log(_BAND)).astype(int)
    means = np.array([excess[bands == band].mean() for band in np.unique(bands)])
    model_ms = loop_model.margins(gains, trial.model, dt_s).ms
    return float(model_ms * math.sqrt(max(1.0, means.max() / np.median(means))))


def look(record: Record, setpoint_um: Series, trial: VerificationTrial, growth_max: float) -> Stage:
    """Judge the record so far, comparing the centre with each sample's setpoint."""
    off_um = record.filled_displacement_um() - setpoint_um
    weather = trial.weather
    replayed = record.duration_s >= _REPLAY_LEAST_S
    if record.duration_s >= _OBSERVE_LEAST_S:
        weather = disturbance.observe(record, trial.model, trial.after)
    std_um = centre_std_um(off_um, trial, weather, trial.after)
    before_um, after_um = (
        predict(loop_model.Gains.of(loop), trial.model, weather, loop).std_um
        for loop in (trial.before, trial.after)
    )
    predicted_growth = after_um / before_um
    if replayed:
        would_um = replayed_um(record, off_um, trial.model, trial.before, trial.pump)
        before_um = centre_std_um(would_um, trial, weather, trial.before)
    if trial.accepted:
        growth_max *= max(1.0, predicted_growth)
    growth = std_um / before_um
    ms = seen_sensitivity(off_um, trial, weather) if replayed else math.nan
    reason = ""
    if growth > growth_max:
        reason = (
            f"the standard deviation is {std_um:.3f} µm, {growth:.2f} times that of the previous "
            "gains"
        )
    elif ms > MS_MAX:
        reason = (
            f"the readings show a sensitivity of {ms:.1f} (limit {MS_MAX:g}): less margin than "
            "designed"
        )
    return Stage(
        record.duration_s, std_um, before_um, growth, growth_max, ms, record.lost_fraction, reason
    )


# Detects an aged loop in an undisturbed hold, from excitation by the weather.
#
# Natural excitation gives the gain k to only 10 or 20 %, enough to detect a pump that has lost a
# third.

LEAST_S = 300.0
# Relative to the prediction for these gains, by design 1.05 to 1.4 times the bound, with
# feed-forward 2.
_RATIO_GROWTH = 1.4
_LEAK_CHANGE = 0.3  # of the leak: the pump's curve and the room for the feedback have moved
_K_SIGMAS, _K_CHANGE = 3.0, 0.15


@dataclass(frozen=True, slots=True)
class Health:
    """Findings from a hold."""

    std_um: float
    least_std_um: float  # lower bound for any controller in this weather
    ratio: float  # of the two, now
    ratio_designed: float  # when the gains were made
    gain: float  # k from natural excitation; NaN if it could not be fitted
    gain_sigma: float
    leak_um_per_s: float  # mean speed balanced by the pump
    suggestions: tuple[str, ...]  # why a session is due; empty if none is


def health(record: Record, setpoint_um: Series, loop: LoopConfig, made: GainsFile) -> Health:
    """Judge a quiet hold against the file its gains come from. Raises ValueError if it is shorter
    than `LEAST_S`.
    """
    if record.duration_s < LEAST_S:
        raise ValueError(
            f"{record.duration_s:.0f} s of hold are too short to judge a loop: need {LEAST_S:.0f} s"
        )
    model = made.plant.model
    weather = disturbance.observe(record, model, loop)
    off_um = record.filled_displacement_um() - setpoint_um
    std_um = centre_std_um(off_um, VerificationTrial(model, weather, loop, loop), weather, loop)
    least_um = least_std_um(model, weather, loop)
    designed = predict(loop_model.Gains.of(loop), model, weather, loop).std_um / least_um
    gain, gain_sigma = _natural_gain(record, loop)
    leak_um_per_s = model.gain * float(record.flow_um_per_s.mean())
    found: list[str] = []
    if std_um / least_um > _RATIO_GROWTH * designed:
        ratio = std_um / (designed * least_um)
        found.append(f"the centre moves {ratio:.1f} times as much as these gains should allow")
    if abs(leak_um_per_s - model.leak_um_per_s) > _LEAK_CHANGE * model.leak_um_per_s:
        found.append(
            f"the leak is {leak_um_per_s:.2f} µm/s, formerly {model.leak_um_per_s:.2f} µm/s"
        )
    spread = math.hypot(gain_sigma, made.plant.gain_sigma)
    if abs(gain - model.gain) > max(_K_SIGMAS * spread, _K_CHANGE * model.gain):
        found.append(f"k is {gain:.2f} +- {gain_sigma:.2f}, formerly {model.gain:.2f}")
    return Health(
        std_um, least_um, std_um / least_um, designed, gain, gain_sigma, leak_um_per_s, tuple(found)
    )


def _natural_gain(record: Record, loop: LoopConfig) -> tuple[float, float]:
    """Gain and standard error without any experiment; NaN where the flow hardly moved.

    With feed-forward most of the flow responds to the air's temperature, and their effects on the
    centre cancel: k would appear far too small. The effect of the air alone is known from the
    loop's own gain, which a pump does not change; the barometer's share is fitted beside k.
    """
    if record.has_thermometer:
        gas_k = disturbance.lagged(record.air_temperature_c, loop.gas_follows_air_s, record.dt_s)
        by_air_um = loop.temperature_gain_um_per_k * gas_k
        record = replace(record, displacement_um=record.displacement_um - by_air_um)
    try:
        found = identify.identify(record)
    except ValueError:
        return math.nan, math.nan
    return found.model.gain, found.sigma.gain
