"""Gains from a model, by well-known rules and by search.

All treat lags as dead time (delay = theta + T + filter + half a sample): the rules are made for an
integrator with delay, and the pump's lag of a tenth of the loop's time constant does not justify a
D term.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from membrane_ctrl.config.schema import LoopConfig
from tuning.identification import loop_model
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal.prediction import predict

# Filters tried by the search; none costs too much phase.
_FILTERS_S = (0.03, 0.05, 0.1, 0.2, 0.4)
# Bounds of the search in K times delay and Ti over delay.
_GAIN_RANGE = (0.01, 1.0)
_TI_RANGE = (2.0, 400.0)
_STEEP = 1e3  # violating a demand costs more than any variance
_SHARE_MOST = 100.0  # finite, so that the search knows its way back


@dataclass(frozen=True, slots=True)
class Demands:
    """Demands on every proposal, whatever their effect on the variance."""

    ms: float = 1.4  # largest sensitivity
    # A step of the leak by half that of a sound mirror must not move the centre further than the
    # band. Without this demand, a mirror without weather would get no gain at all.
    load_step_um_per_s: float = 0.6
    load_peak_um: float = 2.0
    recovery_s: float = 60.0  # three integral times at most
    # A further demand: as good an answer to that step as this one
    as_good_as: loop_model.LoadStep | None = None
    # Standard deviations of the flow's change per tick within the rate limit: beyond, it distorts
    # the loop's answer
    rate_sigmas: float = 1.7
    # Of a reading behind the loop's filter: half of the band; beyond, a mirror at rest is seen to
    # leave the band, and a hold takes minutes to settle
    reading_um: float = 1.0


def load_peak_um(
    gains: loop_model.Gains, model: loop_model.PlantModel, step_um_per_s: float
) -> float:
    """Bound on the largest excursion after a step of the leak: the loop's delay counts as time
    without response.

    For searches: `loop_model.load_step` is exact, smaller, and takes longer.

    y'' + k K y' + k K / Ti y = D delta(t): a step D of the speed peaks at
    D / w0 exp(-zeta w0 t), with w0 = sqrt(k K / Ti) and zeta = sqrt(k K Ti) / 2, where the speed is
    back to 0.
    """
    natural = math.sqrt(model.gain * gains.kp_per_s / gains.ti_s)
    zeta = math.sqrt(model.gain * gains.kp_per_s * gains.ti_s) / 2
    if zeta < 1:
        angle = math.acos(zeta)
        peak = math.exp(-zeta / math.sin(angle) * angle)
    else:
        angle = math.acosh(max(zeta, 1 + 1e-9))
        peak = math.exp(-zeta / math.sinh(angle) * angle)
    return step_um_per_s * (peak / natural + model.delay_s + gains.filter_s)


def effective_delay_s(model: loop_model.PlantModel, dt_s: float, filter_s: float) -> float:
    """Delay of the integrator-with-delay that stands for the loop."""
    return model.delay_s + dt_s / 2 + filter_s


def simc(
    model: loop_model.PlantModel, dt_s: float, filter_s: float, closed_loop_s: float | None = None
) -> loop_model.Gains:
    """SIMC PI: K = 1 / (k (tc + d)), Ti = 4 (tc + d), tc = d unless given (Skogestad 2003)."""
    delay_s = effective_delay_s(model, dt_s, filter_s)
    slowed_s = (delay_s if closed_loop_s is None else closed_loop_s) + delay_s
    return loop_model.Gains(1 / (model.gain * slowed_s), 4 * slowed_s, 0.0, filter_s)


def amigo(model: loop_model.PlantModel, dt_s: float, filter_s: float) -> loop_model.Gains:
    """AMIGO PI for an integrating process: K = 0.35 / (k d), Ti = 13.4 d (Astrom and Hagglund 2006,
    eq. 7.3).
    """
    delay_s = effective_delay_s(model, dt_s, filter_s)
    return loop_model.Gains(0.35 / (model.gain * delay_s), 13.4 * delay_s, 0.0, filter_s)


def lambda_tuned(
    model: loop_model.PlantModel, dt_s: float, filter_s: float, factor: float = 3.0
) -> loop_model.Gains:
    """Lambda PI, lambda = factor x delay: Ti = 2 lambda + d, K = Ti / (k (lambda + d)^2)."""
    delay_s = effective_delay_s(model, dt_s, filter_s)
    lambda_s = factor * delay_s
    ti_s = 2 * lambda_s + delay_s
    return loop_model.Gains(ti_s / (model.gain * (lambda_s + delay_s) ** 2), ti_s, 0.0, filter_s)


def ziegler_nichols(ultimate_gain_per_s: float, ultimate_period_s: float) -> loop_model.Gains:
    """The Ziegler-Nichols PID from a relay: K = 0.6 Ku, Ti = Tu / 2, Td = Tu / 8,
    no filter on D.
    """
    return loop_model.Gains(
        0.6 * ultimate_gain_per_s, ultimate_period_s / 2, ultimate_period_s / 8, 0.0
    )


def max_ki(
    model: loop_model.PlantModel, dt_s: float, filter_s: float, ms: float
) -> loop_model.Gains:
    """PI with the largest K / Ti at a sensitivity below `ms`: best against a step of the leak."""
    start = simc(model, dt_s, filter_s)
    return _search(model, dt_s, start, ms, lambda gains: -math.log(gains.kp_per_s / gains.ti_s))


def least_variance(
    model: loop_model.PlantModel, disturbance: DisturbanceModel, loop: LoopConfig, demands: Demands
) -> loop_model.Gains:
    """PI and filter with the least predicted variance of the true centre, within the demands.

    No D: at best it improves the prediction by 1 %, for twice the pump's activity, and on pumps
    with a second of lag by 5 %: the pump cannot give less than nothing.

    Only the feed-forward of `loop` matters, not its gains.
    """
    dt_s = disturbance.rest.dt_s

    def cost(gains: loop_model.Gains) -> float:
        found = predict(gains, model, disturbance, loop)
        jump = (
            demands.rate_sigmas
            * found.flow_step_std_um_per_s
            / (loop.flow_rate_limit_um_per_s2 * dt_s)
        )
        peak = load_peak_um(gains, model, demands.load_step_um_per_s) / demands.load_peak_um
        slow = 3 * gains.ti_s / demands.recovery_s
        reading = (
            disturbance.laser_um
            * math.sqrt(dt_s / (dt_s + 2 * gains.filter_s))
            / demands.reading_um
        )
        shares = [jump, peak, slow, reading]
        if demands.as_good_as is not None:
            answer = loop_model.load_step(gains, model, demands.load_step_um_per_s, dt_s)
            shares += [answer.peak_um / demands.as_good_as.peak_um]
            shares += [answer.recovery_s / max(demands.as_good_as.recovery_s, dt_s)]
        broken = sum(max(0.0, min(share, _SHARE_MOST) - 1) for share in shares)
        return math.log(found.std_um) + 10 * broken

    starts = (simc(model, dt_s, filter_s, 1.2) for filter_s in _FILTERS_S if filter_s >= dt_s)
    return min((_search(model, dt_s, start, demands.ms, cost) for start in starts), key=cost)


def _search(
    model: loop_model.PlantModel,
    dt_s: float,
    start: loop_model.Gains,
    ms: float,
    cost: Callable[[loop_model.Gains], float],
) -> loop_model.Gains:
    """PI with the least cost at the filter of `start`, with the sensitivity below `ms`; in
    logarithms.
    """
    delay_s = effective_delay_s(model, dt_s, start.filter_s)
    low = np.log([_GAIN_RANGE[0] / (model.gain * delay_s), _TI_RANGE[0] * delay_s])
    high = np.log([_GAIN_RANGE[1] / (model.gain * delay_s), _TI_RANGE[1] * delay_s])

    def gains_at(logs: loop_model.Series) -> loop_model.Gains:
        kp_per_s, ti_s = np.exp(np.clip(logs, low, high)).tolist()
        return loop_model.Gains(kp_per_s, ti_s, 0.0, start.filter_s)

    def penalised(logs: loop_model.Series) -> float:
        gains = gains_at(logs)
        outside = float(np.sum(np.maximum(0.0, low - logs) + np.maximum(0.0, logs - high)))
        peak = loop_model.sensitivity_peak(gains, model, dt_s)
        if not math.isfinite(peak):
            return _STEEP * (10.0 + float(logs[0]))
        return cost(gains) + _STEEP * max(0.0, peak - ms) + outside

    first = np.clip(np.log([start.kp_per_s, start.ti_s]), low, high)
    while (
        not math.isfinite(loop_model.sensitivity_peak(gains_at(first), model, dt_s))
        and first[0] > low[0]
    ):
        first[0] = max(low[0], first[0] - 0.5)
    fit = minimize(
        penalised,
        first,
        method="Nelder-Mead",
        options={"xatol": 1e-3, "fatol": 1e-5, "maxiter": 300},
    )
    return gains_at(fit.x)
