"""Detects an aged loop in an undisturbed hold, from excitation by the weather.

Natural excitation gives the gain k to only 10 or 20 %, enough to detect a pump that has lost a
third.
"""

import math
from dataclasses import dataclass, replace

from membrane_ctrl.config.schema import LoopConfig
from tuning.gains_file import GainsFile
from tuning.identification import closed_loop, disturbance, plant_fit, weather_gains
from tuning.identification.record import Record, Series
from tuning.proposal.lower_bound import compute_least_std_um
from tuning.proposal.prediction import predict_loop
from tuning.proposal.verification import VerificationTrial, estimate_centre_std_um

LEAST_S = 300.0
# Relative to the prediction for these gains, by design 1.05 to 1.4 times the bound, with
# feed-forward 2.
_RATIO_GROWTH = 1.4
_LEAK_CHANGE = 0.3  # of the leak: the pump's curve and the room for the feedback have moved
_K_SIGMAS = 3.0
_K_CHANGE = 0.15


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


def judge_health(record: Record, setpoint_um: Series, loop: LoopConfig, made: GainsFile) -> Health:
    """Judge a quiet hold against the file its gains come from.

    Parameters
    ----------
    record : Record
        The hold.
    setpoint_um : (n,) array
        Setpoint at each sample.
    loop : LoopConfig
        The settings of the hold.
    made : GainsFile
        The plant for which the gains were designed.

    Raises
    ------
    ValueError
        If the record is shorter than `LEAST_S`.
    """
    if record.duration_s < LEAST_S:
        raise ValueError(
            f"{record.duration_s:.0f} s of hold are too short to judge a loop: need {LEAST_S:.0f} s"
        )

    # The centre in this weather, against the least that any controller reaches and against the
    # prediction for these gains.
    model = made.plant.model
    weather = disturbance.observe_disturbance(record, model, loop)
    off_um = record.filled_displacement_um() - setpoint_um
    trial = VerificationTrial(model, weather, loop, loop)
    std_um = estimate_centre_std_um(off_um, trial, weather, loop)
    least_um = compute_least_std_um(model, weather, loop)
    gains = closed_loop.Gains.from_config(loop)
    designed = predict_loop(gains, model, weather, loop).std_um / least_um

    # The plant as it is now.
    gain, gain_sigma = _compute_natural_gain(record, loop)
    leak_um_per_s = model.gain * float(record.flow_um_per_s.mean())

    # What has changed beyond its error.
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


def _compute_natural_gain(record: Record, loop: LoopConfig) -> tuple[float, float]:
    """Gain and standard error without any experiment; NaN where the flow hardly moved.

    With feed-forward most of the flow responds to the air's temperature, and their effects on the
    centre cancel: k would appear far too small. The effect of the air alone is known from the
    loop's own gain, which a pump does not change; the barometer's share is fitted beside k.
    """
    if record.has_thermometer:
        gas_k = weather_gains.lag_series(
            record.air_temperature_c, loop.gas_follows_air_s, record.dt_s
        )
        by_air_um = loop.temperature_gain_um_per_k * gas_k
        record = replace(record, displacement_um=record.displacement_um - by_air_um)
    try:
        found = plant_fit.identify_plant(record)
    except ValueError:
        return math.nan, math.nan
    return found.model.gain, found.sigma.gain
