"""Whether a loop has aged, from a hold that nobody disturbs: what the weather's own excitation tells.

The gain k from natural excitation is known to 10 or 20 % only; that is enough to see a pump that has lost a third.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from membrane_ctrl.config import LoopConfig
from tuning.disturbance_model import observe
from tuning.feedforward_fit import lagged
from tuning.gains_file import GainsFile
from tuning.identify import identify
from tuning.loop_model import Gains
from tuning.minimum_variance import least_std_um, predict
from tuning.records import Record, Series
from tuning.verify import Trial, centre_std_um

LEAST_S = 300.0
# Of what these gains should give: they are 1.05 to 1.4 times the bound by design, with feed-forward 2.
_RATIO_GROWTH = 1.4
_LEAK_CHANGE = 0.3  # of the leak: the pump's curve and the room for the feedback have moved
_K_SIGMAS, _K_CHANGE = 3.0, 0.15


@dataclass(frozen=True, slots=True)
class Health:
    """What a hold shows.

    Attributes
    ----------
    std_um, least_std_um : float
        Of the centre, and the least any controller could reach in this weather.
    ratio, ratio_designed : float
        Of the two, now and when the gains were made.
    gain, gain_sigma : float
        k from natural excitation; NaN if it could not be fitted.
    leak_um_per_s : float
        Mean speed the pump makes up for.
    suggestions : tuple of str
        Why a session is due; empty if it is not.
    """

    std_um: float
    least_std_um: float
    ratio: float
    ratio_designed: float
    gain: float
    gain_sigma: float
    leak_um_per_s: float
    suggestions: tuple[str, ...]


def health(record: Record, setpoint_um: Series, loop: LoopConfig, made: GainsFile) -> Health:
    """Judge a quiet hold against the gains' own file.

    Parameters
    ----------
    record : Record
        At least `LEAST_S` of hold.
    setpoint_um : (n,) array
        The loop's setpoint of each sample.
    loop : LoopConfig
        As it runs.
    made : GainsFile
        Where its gains come from.

    Raises
    ------
    ValueError
        If the record is too short.
    """
    if record.duration_s < LEAST_S:
        raise ValueError(f"{record.duration_s:.0f} s of hold are too short to judge a loop: {LEAST_S:.0f} s at least")
    model = made.plant.model
    weather = observe(record, model, loop)
    off_um = record.filled_displacement_um() - setpoint_um
    std_um = centre_std_um(off_um, Trial(model, weather, loop, loop), weather)
    least_um = least_std_um(model, weather, loop)
    designed = predict(Gains.of(loop), model, weather, loop).std_um / least_um
    gain, gain_sigma = _natural_gain(record, loop)
    leak_um_per_s = model.gain * float(record.flow_um_per_s.mean())
    found: list[str] = []
    if std_um / least_um > _RATIO_GROWTH * designed:
        found.append(
            f"the centre moves {std_um / (designed * least_um):.1f} times as much as these gains should let it"
        )
    if abs(leak_um_per_s - model.leak_um_per_s) > _LEAK_CHANGE * model.leak_um_per_s:
        found.append(f"the leak is {leak_um_per_s:.2f} um/s, it was {model.leak_um_per_s:.2f} um/s")
    spread = math.hypot(gain_sigma, made.plant.gain_sigma)
    if abs(gain - model.gain) > max(_K_SIGMAS * spread, _K_CHANGE * model.gain):
        found.append(f"k is {gain:.2f} +- {gain_sigma:.2f}, it was {model.gain:.2f}")
    return Health(std_um, least_um, std_um / least_um, designed, gain, gain_sigma, leak_um_per_s, tuple(found))


def _natural_gain(record: Record, loop: LoopConfig) -> tuple[float, float]:
    """Gain and standard error without any experiment; NaN where the flow hardly moved.

    With feed-forward most of the flow answers the air's temperature, and what both do to the centre cancels: k would
    look far too small. What the air does by itself is known from the loop's own gain, which a pump does not change;
    the barometer's share is fitted beside k.
    """
    if record.has_thermometer:
        gas_k = lagged(record.air_temperature_c, loop.gas_follows_air_s, record.dt_s)
        by_air_um = loop.temperature_gain_um_per_k * gas_k
        record = replace(record, displacement_um=record.displacement_um - by_air_um)
    try:
        found = identify(record)
    except ValueError:
        return math.nan, math.nan
    return found.model.gain, found.sigma.gain
