"""Limits of the PI's gains by the pump's identified response, so that a slow pump is stable. Pure.

SIMC (S. Skogestad, J. Process Control 13, 2003) for an integrating mirror: with the effective dead
time theta, K = 1 / (tau_c + theta) and Ti = 4 (tau_c + theta). The quickest loop that is allowed is
SIMC's tau_c = theta, of a gain margin of 3. A loop that `tune` has designed is slower.
"""

from membrane_ctrl.config.control import LoopConfig
from membrane_ctrl.control.pump_response import PumpResponse

_CLOSED_LOOP_DEAD_TIMES = 1.0
# Delay of the sampled loop: half a tick from the hold of the flow, and one from reading to flow
_TICKS = 1.5


def find_dead_time_s(loop: LoopConfig, response: PumpResponse) -> float:
    """Effective dead time of the loop: dead time, half of the lag, filter and ticks.

    The standard deviation of dead time and lag together is added: a response that is hardly known
    is taken as a slower one.

    Parameters
    ----------
    loop : LoopConfig
        Filter and rate of the ticks.
    response : PumpResponse
        Dead time and lag of the pump, with their errors.
    """
    pump_s = response.delay_s + response.lag_s / 2.0 + response.sum_sigma_s
    return pump_s + loop.measurement_filter_s + _TICKS / loop.rate_hz


def limit_gains(loop: LoopConfig, response: PumpResponse) -> LoopConfig:
    """The loop with gains that the response allows; the same object if they are within the limits.

    Parameters
    ----------
    loop : LoopConfig
        Its gains are the upper limit: they are never raised.
    response : PumpResponse
        Dead time and lag of the pump, with their errors.

    Returns
    -------
    LoopConfig
    """
    sum_s = (1.0 + _CLOSED_LOOP_DEAD_TIMES) * find_dead_time_s(loop, response)
    kp_per_s = min(loop.kp_per_s, 1.0 / sum_s)
    ti_s = max(loop.ti_s, 4.0 * sum_s)
    if kp_per_s == loop.kp_per_s and ti_s == loop.ti_s:
        return loop
    return loop.model_copy(update={"kp_per_s": kp_per_s, "ti_s": ti_s})
