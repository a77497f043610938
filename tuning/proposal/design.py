"""Designs the candidates from the identified models, and proposes one of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from tuning.identification import (
    closed_loop,
    fit_quality,
    load_step,
    margins,
    plant_fit,
    plant_model,
)
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal import gain_search, lower_bound, tuning_rules
from tuning.proposal.candidate import (
    BALANCED,
    LEAST_VARIANCE,
    PRESENT,
    SAME_LOAD,
    Candidate,
    evaluate_candidate,
)
from tuning.proposal.figures_of_loop import compute_half_widths, compute_loop_figures
from tuning.proposal.preview import Preview, preview_loop
from tuning.proposal.robustness import Robustness, evaluate_robustness, sample_plants

_RULE_FILTER_S = 0.2  # for rules that do not choose a filter, against the laser's noise
# Load peak of the proposal over that of the present gains. The search rounds its gains, so it aims
# a little below.
LOAD_PEAK_MOST = 1.3
_LOAD_PEAK_AIM = 1.28
_MS_TOLERANCE = 1.02  # the search's grid is good to 1 %
_PLANTS = 40  # drawn from the fit, for each candidate's error bars: 1 sigma to a tenth


@dataclass(frozen=True, slots=True)
class Proposal:
    """The tuner's proposal, with its reasons."""

    loop: LoopConfig  # the configuration with the proposed gains and feed-forward
    chosen: Candidate
    candidates: tuple[Candidate, ...]  # including the chosen one and the present gains
    least_std_um: float  # the lower bound
    preview: Preview  # of the chosen one on the fitted twin
    robustness: Robustness


class RefusedError(Exception):
    """The data do not support a proposal; the message states why, and an experiment that helps."""


def choose_feedforward(loop: LoopConfig, disturbance: DisturbanceModel) -> LoopConfig:
    """Return the loop with the fitted weather gains where the data determine them.

    Parameters
    ----------
    loop : LoopConfig
        The present settings.
    disturbance : DisturbanceModel
        Its fits of barometer and thermometer decide (`WeatherGain.choose_gain`).
    """
    changed: dict[str, float] = {}
    if disturbance.barometer is not None:
        changed["barometer_gain_um_per_pa"] = disturbance.barometer.choose_gain(
            loop.barometer_gain_um_per_pa
        )
    if disturbance.air is not None:
        changed["temperature_gain_um_per_k"] = disturbance.air.choose_gain(
            loop.temperature_gain_um_per_k
        )
    rounded = {name: float(f"{value:.4g}") for name, value in changed.items()}
    return LoopConfig.model_validate(loop.model_dump() | rounded)


def compute_relay_ultimate(model: plant_model.PlantModel, dt_s: float) -> tuple[float, float]:
    """Compute what a Ziegler-Nichols relay would find on this plant, without noise.

    An integrator with the delay d has a phase of -180 degrees where w d = pi / 2: Ku = pi /
    (2 k d), Tu = 4 d. Noise makes the gains of the rule even larger.

    Parameters
    ----------
    model : PlantModel
        The plant; its gain and delay matter.
    dt_s : float
        Sample time.

    Returns
    -------
    float, float
        Ultimate gain in 1/s, and period in s.
    """
    delay_s = tuning_rules.compute_effective_delay_s(model, dt_s, 0.0)
    return math.pi / (2 * model.gain * delay_s), 4 * delay_s


def compute_designs(
    model: plant_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    demands: gain_search.Demands,
) -> dict[str, closed_loop.Gains]:
    """Compute the gains of all designs.

    Section 3 of docs/explanation/tuning.md.

    Parameters
    ----------
    model : PlantModel
        The identified plant.
    disturbance : DisturbanceModel
        Noise of the readings, and weather.
    loop : LoopConfig
        The present settings; its feed-forward is that of the designs.
    demands : Demands
        What the searched designs must keep.

    Returns
    -------
    dict of Gains
        By the name of the design (`NAMES`), the proposed ones first; rounded to four digits.
    """
    designs = _search_designs(model, disturbance, loop, demands)
    designs |= _apply_rules(model, disturbance.rest.dt_s, demands.ms)
    return {name: gains.round_to_four_digits() for name, gains in designs.items()}


def _search_designs(
    model: plant_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    demands: gain_search.Demands,
) -> dict[str, closed_loop.Gains]:
    """The designs of least predicted variance by name, the proposed ones first.

    Parameters as of `compute_designs`.
    """
    least = gain_search.search_least_variance(model, disturbance, loop, demands)

    # The other two bound the answer to a step of the leak by that of the present gains: if these
    # are unstable, there is nothing to compare with.
    dt_s = disturbance.rest.dt_s
    present = closed_loop.Gains.from_config(loop)
    if not math.isfinite(margins.find_sensitivity_peak(present, model, dt_s)):
        return {LEAST_VARIANCE: least}
    step_um_per_s = demands.load_step_um_per_s
    present_answer = load_step.simulate_load_step(present, model, step_um_per_s, dt_s)
    least_answer = load_step.simulate_load_step(least, model, step_um_per_s, dt_s)

    # `balanced` is only needed where the least variance moves the centre much further, `same-load`
    # where it moves it further at all.
    designs: dict[str, closed_loop.Gains] = {}
    if least_answer.peak_um > LOAD_PEAK_MOST * present_answer.peak_um:
        bounded = replace(demands, peak_most_um=_LOAD_PEAK_AIM * present_answer.peak_um)
        designs[BALANCED] = gain_search.search_least_variance(model, disturbance, loop, bounded)
    designs[LEAST_VARIANCE] = least
    if least_answer.peak_um > present_answer.peak_um:
        kept = replace(demands, as_good_as=present_answer)
        designs[SAME_LOAD] = gain_search.search_least_variance(model, disturbance, loop, kept)
    return designs


def _apply_rules(
    model: plant_model.PlantModel, dt_s: float, ms: float
) -> dict[str, closed_loop.Gains]:
    """Gains by published rules, by name, and those of the largest K / Ti at a sensitivity `ms`."""
    filter_s = _RULE_FILTER_S
    delay_s = tuning_rules.compute_effective_delay_s(model, dt_s, filter_s)
    ultimate_gain_per_s, ultimate_period_s = compute_relay_ultimate(model, dt_s)
    return {
        "simc": tuning_rules.make_simc_gains(model, dt_s, filter_s),
        "simc-slow": tuning_rules.make_simc_gains(model, dt_s, filter_s, 4 * delay_s),
        "amigo": tuning_rules.make_amigo_gains(model, dt_s, filter_s),
        "lambda": tuning_rules.make_lambda_gains(model, dt_s, filter_s),
        "max-ki": gain_search.search_max_ki(model, dt_s, filter_s, ms),
        "ziegler-nichols": tuning_rules.make_ziegler_nichols_gains(
            ultimate_gain_per_s, ultimate_period_s
        ),
    }


def propose_gains(
    identified: plant_fit.Identified,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    pump: PumpConfig,
    quality: fit_quality.FitQuality,
    demands: gain_search.Demands | None = None,
) -> Proposal:
    """Design on identified data, and propose one of the candidates.

    Parameters
    ----------
    identified : Identified
        The fitted plant with its covariance.
    disturbance : DisturbanceModel
        Noise of the readings, and weather.
    loop : LoopConfig
        The present settings.
    pump : PumpConfig
        Its curve sets what the pump can hold, and is simulated in the preview.
    quality : FitQuality
        Verdict on the fit.
    demands : Demands, optional
        What the searched designs must keep; the defaults without it.

    Returns
    -------
    Proposal

    Raises
    ------
    RefusedError
        If the data were refused, the mirror cannot be held in the pump's range, or no candidate
        keeps the demands.
    """
    # May anything be designed on these data?
    if quality.verdict == "refused":
        raise RefusedError("; ".join(quality.reasons))
    demands = demands or gain_search.Demands()
    model = identified.model
    if not 0 < model.holding_flow_um_per_s < pump.flow_full_um_per_s:
        raise RefusedError(
            f"the leak of {model.leak_um_per_s:.2f} µm/s is outside what the pump can hold: "
            "open the bleed or find the leak, then repeat"
        )

    # The candidates, each with error bars over plants that the fit permits.
    settled = choose_feedforward(loop, disturbance)
    plants = sample_plants(identified, _PLANTS)
    candidates: list[Candidate] = []
    for name, gains in compute_designs(model, disturbance, settled, demands).items():
        designed = evaluate_candidate(name, gains, model, disturbance, settled, demands)
        candidates.append(_add_error_bars(designed, plants, disturbance, settled, demands))

    # The first one is proposed.
    chosen = candidates[0]
    if not chosen.margins.stable or chosen.margins.ms > _MS_TOLERANCE * demands.ms:
        raise RefusedError(f"no gains achieve Ms <= {demands.ms:g} on this plant: reduce the delay")
    proposed = chosen.gains.applied_to(settled)

    # The present gains, with the present feed-forward, are compared with it.
    own = closed_loop.Gains.from_config(loop)
    present = evaluate_candidate(PRESENT, own, model, disturbance, loop, demands)
    present = _add_error_bars(present, plants, disturbance, loop, demands)
    return Proposal(
        loop=proposed,
        chosen=chosen,
        candidates=(chosen, present, *candidates[1:]),
        least_std_um=lower_bound.compute_least_std_um(model, disturbance, settled),
        preview=preview_loop(proposed, pump, model, disturbance),
        robustness=evaluate_robustness(chosen.gains, identified, disturbance, settled),
    )


def _add_error_bars(
    candidate: Candidate,
    plants: Sequence[plant_model.PlantModel],
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    demands: gain_search.Demands,
) -> Candidate:
    """The candidate with 1 sigma of each figure.

    Parameters
    ----------
    candidate : Candidate
        Evaluated on the fitted plant.
    plants : sequence of PlantModel
        Drawn from the covariance of the fit.
    disturbance : DisturbanceModel
        Its weather was not always the same: that scatters the standard deviation, too.
    loop : LoopConfig
        The feed-forward with which the candidate was evaluated.
    demands : Demands
        Its step of the leak.
    """
    step_um_per_s = demands.load_step_um_per_s
    over_plants = [
        compute_loop_figures(candidate.gains, plant, disturbance, loop, step_um_per_s)
        for plant in plants
    ]
    spread = compute_half_widths(over_plants)
    if candidate.predicted is not None:
        weather_um = candidate.predicted.std_um * disturbance.unsteady
        spread = replace(spread, std_um=math.hypot(spread.std_um, weather_um))
    return replace(candidate, sigma=spread)
