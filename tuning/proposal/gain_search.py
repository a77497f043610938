"""Gains from a model by search: least predicted variance, or largest integral gain."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from membrane_ctrl.config.schema import LoopConfig
from tuning.identification import closed_loop, load_step, margins, plant_model, record
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal.prediction import predict_loop
from tuning.proposal.tuning_rules import compute_effective_delay_s, make_simc_gains

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
    # Further demands: the exact peak after that step, and as good an answer to it as this one
    peak_most_um: float = math.inf
    as_good_as: load_step.LoadStep | None = None
    # Standard deviations of the flow's change per tick within the rate limit: beyond, it distorts
    # the loop's answer
    rate_sigmas: float = 1.7
    # Of a reading behind the loop's filter: half of the band; beyond, a mirror at rest is seen to
    # leave the band, and a hold takes minutes to settle
    reading_um: float = 1.0


def bound_load_peak_um(
    gains: closed_loop.Gains, model: plant_model.PlantModel, step_um_per_s: float
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


def search_max_ki(
    model: plant_model.PlantModel, dt_s: float, filter_s: float, ms: float
) -> closed_loop.Gains:
    """PI with the largest K / Ti at a sensitivity below `ms`: best against a step of the leak."""
    start = make_simc_gains(model, dt_s, filter_s)
    return _search_gains(
        model, dt_s, start, ms, lambda gains: -math.log(gains.kp_per_s / gains.ti_s)
    )


def search_least_variance(
    model: plant_model.PlantModel, disturbance: DisturbanceModel, loop: LoopConfig, demands: Demands
) -> closed_loop.Gains:
    """PI and filter with the least predicted variance of the true centre, within the demands.

    No D: at best it improves the prediction by 1 %, for twice the pump's activity, and on pumps
    with a second of lag by 5 %: the pump cannot give less than nothing.

    Only the feed-forward of `loop` matters, not its gains.
    """
    dt_s = disturbance.rest.dt_s

    def cost(gains: closed_loop.Gains) -> float:
        found = predict_loop(gains, model, disturbance, loop)
        jump = (
            demands.rate_sigmas
            * found.flow_step_std_um_per_s
            / (loop.flow_rate_limit_um_per_s2 * dt_s)
        )
        peak = bound_load_peak_um(gains, model, demands.load_step_um_per_s) / demands.load_peak_um
        slow = 3 * gains.ti_s / demands.recovery_s
        reading = (
            disturbance.laser_um
            * math.sqrt(dt_s / (dt_s + 2 * gains.filter_s))
            / demands.reading_um
        )
        shares = [jump, peak, slow, reading]
        if math.isfinite(demands.peak_most_um):
            answer = load_step.simulate_load_step(gains, model, demands.load_step_um_per_s, dt_s)
            shares += [answer.peak_um / demands.peak_most_um]
        if demands.as_good_as is not None:
            answer = load_step.simulate_load_step(gains, model, demands.load_step_um_per_s, dt_s)
            shares += [answer.peak_um / demands.as_good_as.peak_um]
            shares += [answer.recovery_s / max(demands.as_good_as.recovery_s, dt_s)]
        broken = sum(max(0.0, min(share, _SHARE_MOST) - 1) for share in shares)
        return math.log(found.std_um) + 10 * broken

    starts = (
        make_simc_gains(model, dt_s, filter_s, 1.2) for filter_s in _FILTERS_S if filter_s >= dt_s
    )
    return min((_search_gains(model, dt_s, start, demands.ms, cost) for start in starts), key=cost)


def _search_gains(
    model: plant_model.PlantModel,
    dt_s: float,
    start: closed_loop.Gains,
    ms: float,
    cost: Callable[[closed_loop.Gains], float],
) -> closed_loop.Gains:
    """PI with the least cost at the filter of `start`, with the sensitivity below `ms`; in
    logarithms.
    """
    delay_s = compute_effective_delay_s(model, dt_s, start.filter_s)
    low = np.log([_GAIN_RANGE[0] / (model.gain * delay_s), _TI_RANGE[0] * delay_s])
    high = np.log([_GAIN_RANGE[1] / (model.gain * delay_s), _TI_RANGE[1] * delay_s])

    def gains_at(logs: record.Series) -> closed_loop.Gains:
        kp_per_s, ti_s = np.exp(np.clip(logs, low, high)).tolist()
        return closed_loop.Gains(kp_per_s, ti_s, 0.0, start.filter_s)

    def penalised(logs: record.Series) -> float:
        gains = gains_at(logs)
        outside = float(np.sum(np.maximum(0.0, low - logs) + np.maximum(0.0, logs - high)))
        peak = margins.find_sensitivity_peak(gains, model, dt_s)
        if not math.isfinite(peak):
            return _STEEP * (10.0 + float(logs[0]))
        return cost(gains) + _STEEP * max(0.0, peak - ms) + outside

    first = np.clip(np.log([start.kp_per_s, start.ti_s]), low, high)
    while (
        not math.isfinite(margins.find_sensitivity_peak(gains_at(first), model, dt_s))
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
