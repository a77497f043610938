"""Gains from a model by search: least predicted variance, or largest integral gain."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from membrane_ctrl.config.schema import LoopConfig
from tuning.identification import closed_loop, load_step, margins, plant_model, record
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal.prediction import Predicted, predict_loop
from tuning.proposal.tuning_rules import compute_effective_delay_s, make_simc_gains

# Filters tried by the search; none costs too much phase.
_FILTERS_S = (0.03, 0.05, 0.1, 0.2, 0.4)
# Bounds of the search in K times delay and Ti over delay.
_GAIN_RANGE = (0.01, 1.0)
_TI_RANGE = (2.0, 400.0)
_STEEP = 1e3  # violating a demand costs more than any variance
_SHARE_MOST = 100.0  # finite, so that the cost has a slope that leads back
_PRICE_OF_BROKEN = 10.0  # of the logarithm of the standard deviation, for a figure twice its limit
_START_CLOSED_LOOP_S = 1.2  # of the SIMC gains at which each search begins


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
    """Bound on the largest excursion after a step of the leak.

    The loop's delay counts as time without response. For searches:
    `load_step.simulate_load_step` is exact, smaller, and takes longer.

    y'' + k K y' + k K / Ti y = D delta(t): a step D of the speed peaks at
    D / w0 exp(-zeta w0 t), with w0 = sqrt(k K / Ti) and zeta = sqrt(k K Ti) / 2, where the speed is
    back to 0.

    Parameters
    ----------
    gains : Gains
        K, Ti and the filter.
    model : PlantModel
        Gain and delay.
    step_um_per_s : float
        D.

    Returns
    -------
    float
        In µm.
    """
    # The peak of the second-order answer; while the loop does not see the step yet, for its delay
    # and filter, the centre moves on at the step's speed.
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
    """Find the PI with the largest K / Ti: best against a step of the leak.

    Parameters
    ----------
    model : PlantModel
        The identified plant.
    dt_s, filter_s : float
        Sample time, and the filter of the reading.
    ms : float
        Largest sensitivity.
    """
    start = make_simc_gains(model, dt_s, filter_s)
    return _search_gains(
        model, dt_s, start, ms, lambda gains: -math.log(gains.kp_per_s / gains.ti_s)
    )


def search_least_variance(
    model: plant_model.PlantModel, disturbance: DisturbanceModel, loop: LoopConfig, demands: Demands
) -> closed_loop.Gains:
    """Find PI and filter with the least predicted variance of the true centre.

    No D: at best it improves the prediction by 1 %, for twice the pump's activity, and on pumps
    with a second of lag by 5 %: the pump cannot give less than nothing.

    Parameters
    ----------
    model : PlantModel
        The identified plant.
    disturbance : DisturbanceModel
        Noise of the readings, and weather.
    loop : LoopConfig
        Only its feed-forward and its limits matter, not its gains.
    demands : Demands
        What the gains must keep, as far as any gains do.
    """
    dt_s = disturbance.rest.dt_s

    def cost(gains: closed_loop.Gains) -> float:
        """Logarithm of the standard deviation, and a price for each broken demand."""
        predicted = predict_loop(gains, model, disturbance, loop)
        shares = _demanded_shares(gains, predicted, model, disturbance, loop, demands)
        broken = sum(max(0.0, min(share, _SHARE_MOST) - 1) for share in shares)
        return math.log(predicted.std_um) + _PRICE_OF_BROKEN * broken

    # One search for each filter: the variance has a minimum for each.
    found = []
    for filter_s in _FILTERS_S:
        if filter_s >= dt_s:
            start = make_simc_gains(model, dt_s, filter_s, _START_CLOSED_LOOP_S)
            found.append(_search_gains(model, dt_s, start, demands.ms, cost))
    return min(found, key=cost)


def _demanded_shares(
    gains: closed_loop.Gains,
    predicted: Predicted,
    model: plant_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    demands: Demands,
) -> list[float]:
    """Each demanded figure over its limit: above 1 where the demand is broken."""
    dt_s = disturbance.rest.dt_s
    step_um_per_s = demands.load_step_um_per_s

    # The flow's change from tick to tick, over the rate limit.
    limit_um_per_s = loop.flow_rate_limit_um_per_s2 * dt_s
    rate = demands.rate_sigmas * predicted.flow_step_std_um_per_s / limit_um_per_s

    # The excursion and its recovery after a step of the leak.
    peak = bound_load_peak_um(gains, model, step_um_per_s) / demands.load_peak_um
    recovery = 3 * gains.ti_s / demands.recovery_s

    # The laser's noise behind the filter.
    passed = math.sqrt(dt_s / (dt_s + 2 * gains.filter_s))
    reading = disturbance.laser_um * passed / demands.reading_um
    shares = [rate, peak, recovery, reading]

    # Further demands, by the exact answer to that step.
    reference = demands.as_good_as
    if reference is None and not math.isfinite(demands.peak_most_um):
        return shares
    answer = load_step.simulate_load_step(gains, model, step_um_per_s, dt_s)
    if math.isfinite(demands.peak_most_um):
        shares.append(answer.peak_um / demands.peak_most_um)
    if reference is not None:
        shares.append(answer.peak_um / reference.peak_um)
        shares.append(answer.recovery_s / max(reference.recovery_s, dt_s))
    return shares


def _search_gains(
    model: plant_model.PlantModel,
    dt_s: float,
    start: closed_loop.Gains,
    ms: float,
    cost: Callable[[closed_loop.Gains], float],
) -> closed_loop.Gains:
    """Find the PI with the least cost at the filter of `start`, with a sensitivity below `ms`.

    Nelder and Mead's method in the logarithms of K and Ti: the cost has kinks where a demand is
    broken.
    """
    # Bounds in units of the plant: K times k d, and Ti over d.
    delay_s = compute_effective_delay_s(model, dt_s, start.filter_s)
    low = np.log([_GAIN_RANGE[0] / (model.gain * delay_s), _TI_RANGE[0] * delay_s])
    high = np.log([_GAIN_RANGE[1] / (model.gain * delay_s), _TI_RANGE[1] * delay_s])

    def gains_at(logs: record.Series) -> closed_loop.Gains:
        """The gains with these logarithms, inside the bounds."""
        kp_per_s, ti_s = np.exp(np.clip(logs, low, high)).tolist()
        return closed_loop.Gains(kp_per_s, ti_s, 0.0, start.filter_s)

    def penalised(logs: record.Series) -> float:
        """Cost, with a slope that leads back from beyond bounds and sensitivity."""
        gains = gains_at(logs)
        outside = float(np.sum(np.maximum(0.0, low - logs) + np.maximum(0.0, logs - high)))
        peak = margins.find_sensitivity_peak(gains, model, dt_s)
        if not math.isfinite(peak):
            return _STEEP * (10.0 + float(logs[0]))  # unstable: less K is better
        return cost(gains) + _STEEP * max(0.0, peak - ms) + outside

    # Begin with a stable loop.
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
