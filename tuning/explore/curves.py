"""What a set of gains would do: its margins, responses and spectra."""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.model import arrays
from tuning.explore.crossings import unwrap_phase_deg
from tuning.explore.workpiece import Workpiece
from tuning.identification import closed_loop, plant_model
from tuning.proposal import candidate, gain_search

STEP_UM = 1.0
_SETTLINGS = 25.0  # duration of the responses in delays and closed-loop time constants
_POINTS_MAX = 6000


@dataclass(frozen=True, slots=True)
class Curves:
    """Responses of one set of gains; a loop that is unstable has none over time."""

    figures: candidate.Candidate
    time_s: arrays.FloatArray  # (n,)
    step_um: arrays.FloatArray  # (n,): the centre after a setpoint step of `STEP_UM`
    load_um: arrays.FloatArray  # (n,): the centre after a step of the leak
    w_rad_per_s: arrays.FloatArray  # (m,)
    open_loop: arrays.ComplexArray  # (m,): L
    # (m,): two-sided spectrum of the true centre in the recorded weather
    centre_um2_s: arrays.FloatArray

    @property
    def phase_deg(self) -> arrays.FloatArray:
        """Of the open loop, (m,)."""
        return unwrap_phase_deg(self.open_loop)


def compute_curves(name: str, gains: closed_loop.Gains, of: Workpiece, duration_s: float) -> Curves:
    """Everything the page draws of a set of gains.

    Parameters
    ----------
    name : str
        Name of the candidate.
    gains : Gains
        The gains.
    of : Workpiece
        Plant, weather and configuration that they are for.
    duration_s : float
        Length of the responses to steps.
    """
    dt_s = of.weather.rest.dt_s
    demands = gain_search.Demands()
    figures = candidate.evaluate_candidate(name, gains, of.model, of.weather, of.loop, demands)
    w = closed_loop.make_frequencies(dt_s)
    response = closed_loop.compute_loop_response(gains, of.model, w, dt_s)
    # Two sources move the true centre: weather through the sensitivity S = 1 / (1 + L), and the
    # laser's noise, which the loop follows, through T = 1 - S.
    sensitivity = 1 / (1 + response)
    moving, noise = of.weather.psd(w, of.model, of.loop), of.weather.rest.white_psd
    centre = np.abs(sensitivity) ** 2 * moving + np.abs(1 - sensitivity) ** 2 * noise
    time_s = step_um = load_um = np.empty(0)
    if figures.margins.stable:
        time_s, step_um = simulate_response(gains, of, duration_s, STEP_UM, 0.0)
        _, load_um = simulate_response(gains, of, duration_s, 0.0, demands.load_step_um_per_s)
    return Curves(figures, time_s, step_um, load_um, w, response, centre)


def find_duration_s(gains: closed_loop.Gains, model: plant_model.PlantModel) -> float:
    """Duration in which the responses of the gains settle, s.

    Parameters
    ----------
    gains : Gains
        Of the loop.
    model : PlantModel
        Its dead time and lag set the scale together with filter and integral time.
    """
    return _SETTLINGS * (model.delay_s + gains.filter_s + 0.2 * gains.ti_s)


def simulate_response(
    gains: closed_loop.Gains,
    of: Workpiece,
    duration_s: float,
    setpoint_um: float,
    load_um_per_s: float,
) -> tuple[arrays.FloatArray, arrays.FloatArray]:
    """Centre of the mirror, linear and without noise, after steps of setpoint and leak at time 0.

    Parameters
    ----------
    gains : Gains
        The loop's gains.
    of : Workpiece
        Plant and configuration.
    duration_s : float
        Length of the simulation.
    setpoint_um, load_um_per_s : float
        The steps.

    Returns
    -------
    time_s, centre_um : (n,) arrays
        At each tick; the delayed flow changes once within a tick, which is taken into account.
    """
    # The controller of the hold, tick by tick: measurement filter, setpoint behind the same filter,
    # PI with derivative on the measurement.
    loop, model = of.loop, of.model
    dt_s = max(of.weather.rest.dt_s, duration_s / _POINTS_MAX)
    shaped = _Setpoint(loop, gains.ti_s, dt_s)
    smooth = -math.expm1(-dt_s / gains.filter_s) if gains.filter_s > 0 else 1.0
    count = max(2, round(duration_s / dt_s))
    whole = int(model.dead_time_s // dt_s)
    # share of a tick that the newer of two flows lasts
    early = 1.0 - (model.dead_time_s / dt_s - whole)
    follow = -math.expm1(-dt_s / model.lag_s) if model.lag_s > 0 else 1.0
    flows = [0.0] * (whole + 2)
    centre = filtered = matched = integral = speed = 0.0
    out = np.empty(count)
    for tick in range(count):
        out[tick] = centre
        before = filtered
        filtered += smooth * (centre - filtered)
        matched += smooth * (shaped.at(setpoint_um) - matched)
        error = matched - filtered
        flow = gains.kp_per_s * (error - gains.td_s * (filtered - before) / dt_s) + integral
        integral += gains.kp_per_s / gains.ti_s * error * dt_s
        # The plant: the flow after its dead time, through the lag of first order to the speed of
        # the centre, integrated by the trapezoidal rule.
        flows = [flow, *flows[:-1]]
        arriving = model.gain * (early * flows[whole] + (1.0 - early) * flows[whole + 1])
        old_speed = speed
        speed += follow * (arriving - speed)
        centre += ((old_speed + speed) / 2 - load_um_per_s) * dt_s
    return np.arange(count, dtype=float) * dt_s, out


class _Setpoint:
    """The setpoint behind its weight b: (1 + b Ti s) / (1 + Ti s), as the hold shapes it."""

    def __init__(self, loop: LoopConfig, ti_s: float, dt_s: float) -> None:
        self._weight = loop.setpoint_weight
        self._slow = 0.0
        self._share = -math.expm1(-dt_s / ti_s)

    def at(self, setpoint_um: float) -> float:
        self._slow += self._share * (setpoint_um - self._slow)
        return self._slow + self._weight * (setpoint_um - self._slow)
