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
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import welch

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from tuning.identification import closed_loop, disturbance, margins, plant_model
from tuning.identification.record import Record, Series
from tuning.proposal.prediction import linearise_limits, predict_loop
from tuning.proposal.record_replay import replay_um

# Time of a stage, and growth that ends the trial there: early on only plain failures, as a minute
# of weather scatters by a third; at the end the required 10 %.
STAGES = ((60.0, 2.0), (180.0, 1.5), (300.0, 1.3), (600.0, 1.10))
SETTLE_LEAST_S = 20.0
_SETTLE_MOST_S = 120.0
# of the loop's slowest mode: 2 % of the transient from the change of gains is left
_SETTLE_TIME_CONSTANTS = 4.0
MS_MAX = 2.0  # sensitivity seen; its estimate scatters by a tenth
MS_PRESENT_MAX = 1.6  # previous gains beyond it lack margin: `gains_file` refuses them
_CLOSE = 1.13  # of the largest growth
# Gains that are no better are of no use. Standard errors of the growth by which it must be below
# 1: the same gains would pass in 1 of 15 verifications
_CERTAIN_SIGMAS = 1.5
_ERROR_BLOCK_S = 30.0  # several times the loop's memory: the blocks scatter independently
_ERROR_BLOCKS_LEAST = 5
# Of the replayed loop against the one that held: 24 holds with unchanged gains scatter by this
_REPLAY_SIGMA = 0.03
# A larger predicted growth cannot be shown to be a benefit
GROWTH_OF_BENEFIT = 1.0 - _CERTAIN_SIGMAS * _REPLAY_SIGMA
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
    growth_sigma: float  # standard error of the ratio; infinite while the record is too short
    ms: float  # sensitivity seen; NaN while the record is too short
    lost_fraction: float  # readings lost
    reason: str  # why it fails; empty if it passes

    @property
    def is_close(self) -> bool:
        """Whether it fails by less than the standard deviation of ten minutes scatters, or whether
        the new gains look better by less than the error of the comparison.
        """
        if self.growth > self.growth_max:
            return self.growth < _CLOSE * self.growth_max
        return self.growth + self.growth_sigma < 1.0 and not self.is_better

    @property
    def is_better(self) -> bool:
        """Whether the standard deviation is smaller, beyond the error of the comparison."""
        return self.growth + _CERTAIN_SIGMAS * self.growth_sigma < 1.0


def find_settling_time_s(loop: LoopConfig) -> float:
    """Settling time of the centre after the change to these gains.

    Without delay and filter the loop around the film's integral is s^2 + K s + K / Ti = 0 (Td is
    small beside both); its slowest root has the real part (K - sqrt(K^2 - 4 K / Ti)) / 2, or K / 2
    where it swings.
    """
    k = loop.kp_per_s
    discriminant = k * k - 4 * k / loop.ti_s
    slowest_per_s = (k - math.sqrt(max(0.0, discriminant))) / 2
    slowest_s = math.inf
    if slowest_per_s > 0:
        slowest_s = 1 / slowest_per_s
    return min(max(SETTLE_LEAST_S, _SETTLE_TIME_CONSTANTS * slowest_s), _SETTLE_MOST_S)


@dataclass(frozen=True, slots=True)
class VerificationTrial:
    """The data of the comparison."""

    model: plant_model.PlantModel
    weather: disturbance.DisturbanceModel
    before: LoopConfig
    after: LoopConfig
    # a person chose these gains knowing that a larger deviation is predicted
    accepted: bool = False
    pump: PumpConfig = field(default_factory=PumpConfig)


def estimate_centre_std_um(
    off_um: Series,
    trial: VerificationTrial,
    weather: disturbance.DisturbanceModel,
    loop: LoopConfig,
) -> float:
    """Standard deviation of the centre without the laser's noise.

    The equation of the module: the prediction, corrected by the autocovariance that was seen.

    Parameters
    ----------
    off_um : (n,) array
        Readings less setpoint, under `loop`.
    trial : VerificationTrial
        Its plant.
    weather : DisturbanceModel
        The weather in which the loop is predicted.
    loop : LoopConfig
        The loop that held the mirror.

    Returns
    -------
    float
        In µm; 0 if the estimated variance is negative.
    """
    # Autocovariance of the readings over short lags.
    dt_s = weather.rest.dt_s
    off = off_um - off_um.mean()
    lags = np.arange(1, round(_LAGS_S / dt_s) + 1)
    seen_um2 = np.array([off[lag:] @ off[:-lag] / (off.size - lag) for lag in lags])

    # The same by the model: the spectrum |S|^2 (motion + noise) of the readings without its white
    # part, which has no covariance over a lag, as an integral over the frequencies.
    gains = closed_loop.Gains.from_config(loop)
    w = closed_loop.make_frequencies(dt_s, _POINTS)
    model, moving = linearise_limits(gains, trial.model, weather, loop, w)
    response = closed_loop.compute_loop_response(gains, model, w, dt_s)
    sensitivity = np.abs(1 / (1 + response)) ** 2
    noise = weather.rest.white_psd
    coloured = sensitivity * (moving + noise) - noise
    over_lags = coloured * np.cos(np.outer(lags * dt_s, w))
    predicted_um2 = np.trapezoid(over_lags, w, axis=1) / np.pi

    # What exceeds it corrects the predicted variance.
    std_um = predict_loop(gains, trial.model, weather, loop).std_um
    return math.sqrt(max(0.0, std_um**2 + float(np.mean(seen_um2 - predicted_um2))))


def estimate_growth_sigma(
    after_um: Series, before_um: Series, after_std_um: float, before_std_um: float, dt_s: float
) -> float:
    """Standard error of the ratio of two standard deviations in the same weather.

    Both have the scatter of that weather, so that the difference of their relative variances in
    blocks of the record is what scatters. To this comes the error of the replay.

    Parameters
    ----------
    after_um, before_um : (n,) arrays
        Readings less setpoint, of the loop that held and of the replayed one.
    after_std_um, before_std_um : float
        Standard deviations of the centre under both.
    dt_s : float
        Sample time.

    Returns
    -------
    float
        Infinite for a record that is too short.
    """
    size = min(after_um.size, before_um.size)
    blocks = math.floor(size * dt_s / _ERROR_BLOCK_S)
    if blocks < _ERROR_BLOCKS_LEAST or after_std_um <= 0 or before_std_um <= 0:
        return math.inf

    def block_variances(off_um: Series) -> Series:
        """Variance of the motion in each block, µm^2."""
        off = off_um[:size] - off_um[:size].mean()
        return np.array([_mean_covariance(part, dt_s) for part in np.array_split(off, blocks)])

    # A standard deviation has half of the relative error of its variance.
    difference = block_variances(after_um) / after_std_um**2
    difference -= block_variances(before_um) / before_std_um**2
    scatter = 0.5 * float(np.std(difference, ddof=1)) / math.sqrt(blocks)
    return after_std_um / before_std_um * math.hypot(scatter, _REPLAY_SIGMA)


def _mean_covariance(off_um: Series, dt_s: float) -> float:
    """Mean autocovariance over the lags in which the centre's motion dominates, µm^2."""
    lags = range(1, round(_LAGS_S / dt_s) + 1)
    return float(np.mean([off_um[lag:] @ off_um[:-lag] / (off_um.size - lag) for lag in lags]))


def estimate_sensitivity(
    off_um: Series, trial: VerificationTrial, weather: disturbance.DisturbanceModel
) -> float:
    """Largest sensitivity, from the excess of the spectrum over the model's prediction.

    Increased gain or delay of the plant shows as a broad peak near the crossover, all the time. The
    level of the weather does not matter: only the shape is compared, each band with the median
    band. Doors and gusts are in a few segments, a pump's pulsation in a few bins of a band: medians
    over both leave them out.

    Parameters
    ----------
    off_um : (n,) array
        Readings less setpoint, under the new gains.
    trial : VerificationTrial
        The plant, and the new gains.
    weather : DisturbanceModel
        Of this record.

    Returns
    -------
    float
        Ms; that of the model if the spectrum has its shape.
    """
    # Spectrum of the readings, up to twice the frequency at which the delay's phase is a quarter.
    gains = closed_loop.Gains.from_config(trial.after)
    dt_s = weather.rest.dt_s
    frequency_hz, power = welch(
        off_um,
        1 / dt_s,
        nperseg=round(_SEGMENT_S / dt_s),
        detrend="constant",
        average="median",
    )
    w: Series = 2 * np.pi * frequency_hz
    fastest = math.pi / (2 * (trial.model.delay_s + gains.filter_s + dt_s))
    used = (w > 2 * np.pi * 3 / _SEGMENT_S) & (w < 2 * fastest)
    w = w[used]
    power = power[used]

    # Its excess over the prediction |S|^2 (motion + noise), where the loop amplifies: slower motion
    # that exceeds the prediction is weather, or a limit of the pump.
    model, moving = linearise_limits(gains, trial.model, weather, trial.after, w)
    response = closed_loop.compute_loop_response(gains, model, w, dt_s)
    squared_sensitivity = np.abs(1 / (1 + response)) ** 2
    expected = squared_sensitivity * (moving + weather.rest.white_psd)
    amplified = squared_sensitivity >= min(1.0, squared_sensitivity.max())
    excess = power[amplified] / expected[amplified]

    # The band with the largest median, against the median band.
    band_of = np.floor(np.log(w[amplified] / w[0]) / math.log(_BAND)).astype(int)
    levels = np.array([np.median(excess[band_of == band]) for band in np.unique(band_of)])
    model_ms = margins.compute_margins(gains, trial.model, dt_s).ms
    return float(model_ms * math.sqrt(max(1.0, levels.max() / np.median(levels))))


def judge_stage(
    record: Record, setpoint_um: Series, trial: VerificationTrial, growth_max: float
) -> Stage:
    """Judge the record so far.

    Parameters
    ----------
    record : Record
        The hold with the new gains.
    setpoint_um : (n,) array
        Setpoint at each of its samples.
    trial : VerificationTrial
        Plant, weather of the session, and both gains.
    growth_max : float
        Limit of the standard deviation over that of the previous gains.

    Returns
    -------
    Stage
    """
    # The centre under the new gains, in the weather of this record once that is known.
    off_um = record.filled_displacement_um() - setpoint_um
    weather = trial.weather
    if record.duration_s >= _OBSERVE_LEAST_S:
        weather = disturbance.observe_disturbance(record, trial.model, trial.after)
    std_um = estimate_centre_std_um(off_um, trial, weather, trial.after)

    # Under the previous gains: predicted, and replayed in this weather once there is enough of it.
    predicted_before_um = _predict_std_um(trial.before, trial, weather)
    predicted_after_um = _predict_std_um(trial.after, trial, weather)
    before_um = predicted_before_um
    growth_sigma = math.inf
    ms = math.nan
    if record.duration_s >= _REPLAY_LEAST_S:
        would_um = replay_um(record, off_um, trial.model, trial.before, trial.pump)
        before_um = estimate_centre_std_um(would_um, trial, weather, trial.before)
        growth_sigma = estimate_growth_sigma(off_um, would_um, std_um, before_um, record.dt_s)
        ms = estimate_sensitivity(off_um, trial, weather)

    # The verdict. A person who chose these gains has accepted the growth that was predicted.
    if trial.accepted:
        growth_max *= max(1.0, predicted_after_um / predicted_before_um)
    growth = std_um / before_um
    return Stage(
        time_s=record.duration_s,
        std_um=std_um,
        before_um=before_um,
        growth=growth,
        growth_max=growth_max,
        growth_sigma=growth_sigma,
        ms=ms,
        lost_fraction=record.lost_fraction,
        reason=_explain_failure(std_um, growth, growth_max, ms),
    )


def _predict_std_um(
    loop: LoopConfig, trial: VerificationTrial, weather: disturbance.DisturbanceModel
) -> float:
    """Predicted standard deviation of the centre under a loop."""
    gains = closed_loop.Gains.from_config(loop)
    return predict_loop(gains, trial.model, weather, loop).std_um


def _explain_failure(std_um: float, growth: float, growth_max: float, ms: float) -> str:
    """Why a stage fails; empty if it passes, also with an unknown sensitivity (NaN)."""
    if growth > growth_max:
        return (
            f"the standard deviation is {std_um:.3f} µm, {growth:.2f} times that of the previous "
            "gains"
        )
    if ms > MS_MAX:
        return (
            f"the readings show a sensitivity of {ms:.1f} (limit {MS_MAX:g}): less margin than "
            "designed"
        )
    return ""


def explain_no_benefit(stage: Stage, trial: VerificationTrial) -> str:
    """Why gains that passed the last stage are not worth keeping; empty if they are.

    Gains whose price a person accepted are, and so are those that replace gains without enough
    margin. A record too short for a replay shows no benefit: after such a short verification it is
    enough that the gains are no worse.

    Parameters
    ----------
    stage : Stage
        The last one.
    trial : VerificationTrial
        Previous and new gains, and whether a person accepted their price.
    """
    if math.isinf(stage.growth_sigma):
        return ""
    present = closed_loop.Gains.from_config(trial.before)
    present_ms = margins.find_sensitivity_peak(present, trial.model, trial.weather.rest.dt_s)
    if trial.accepted or present_ms > MS_PRESENT_MAX or stage.is_better:
        return ""
    return (
        f"the standard deviation is {stage.growth:.2f} +- {stage.growth_sigma:.2f} of that of the "
        "previous gains: no better beyond the error of the comparison"
    )
