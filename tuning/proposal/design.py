"""Designs the candidates from the identified models, and proposes one of them."""

import math
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

# The Ziegler-Nichols relay on this loop sees a limit cycle where the phase is -180 deg, w d = pi /
# 2: Ku = pi / (2 k d), Tu = 4 d. Noise makes theirs even larger.
_RULE_FILTER_S = 0.2  # for rules that do not choose a filter, against the laser's noise
# Load peak of the proposal over that of the present gains. The search rounds its gains, so it aims
# a little below.
LOAD_PEAK_MOST = 1.3
_LOAD_PEAK_AIM = 1.28
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
    """The loop with the fitted weather gains where the data determine
    them (`WeatherGain.choose_gain`).
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
    """Ultimate gain in 1/s and period in s of the integrator with delay: Ku = pi / (2 k d), Tu = 4
    d.
    """
    delay_s = tuning_rules.compute_effective_delay_s(model, dt_s, 0.0)
    return math.pi / (2 * model.gain * delay_s), 4 * delay_s


def compute_designs(
    model: plant_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    demands: gain_search.Demands,
) -> dict[str, closed_loop.Gains]:
    """Gains by the name of their design (`NAMES`), the proposed ones first."""
    dt_s, filter_s = disturbance.rest.dt_s, _RULE_FILTER_S
    delay_s = tuning_rules.compute_effective_delay_s(model, dt_s, filter_s)
    least = gain_search.search_least_variance(model, disturbance, loop, demands)
    found: dict[str, closed_loop.Gains] = {}
    step_um_per_s, present = demands.load_step_um_per_s, closed_loop.Gains.from_config(loop)
    if math.isfinite(margins.find_sensitivity_peak(present, model, dt_s)):
        answer = load_step.simulate_load_step(present, model, step_um_per_s, dt_s)
        peak_um = load_step.simulate_load_step(least, model, step_um_per_s, dt_s).peak_um
        if peak_um > LOAD_PEAK_MOST * answer.peak_um:
            bounded = replace(demands, peak_most_um=_LOAD_PEAK_AIM * answer.peak_um)
            found[BALANCED] = gain_search.search_least_variance(model, disturbance, loop, bounded)
        found[LEAST_VARIANCE] = least
        if peak_um > answer.peak_um:
            kept = replace(demands, as_good_as=answer)
            found[SAME_LOAD] = gain_search.search_least_variance(model, disturbance, loop, kept)
    else:
        found[LEAST_VARIANCE] = least
    found |= {
        "simc": tuning_rules.make_simc_gains(model, dt_s, filter_s),
        "simc-slow": tuning_rules.make_simc_gains(model, dt_s, filter_s, 4 * delay_s),
        "amigo": tuning_rules.make_amigo_gains(model, dt_s, filter_s),
        "lambda": tuning_rules.make_lambda_gains(model, dt_s, filter_s),
        "max-ki": gain_search.search_max_ki(model, dt_s, filter_s, demands.ms),
        "ziegler-nichols": tuning_rules.make_ziegler_nichols_gains(
            *compute_relay_ultimate(model, dt_s)
        ),
    }
    return {name: gains.round_to_four_digits() for name, gains in found.items()}


def propose_gains(
    identified: plant_fit.Identified,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    pump: PumpConfig,
    quality: fit_quality.FitQuality,
    demands: gain_search.Demands | None = None,
) -> Proposal:
    """Design on identified data.

    Raises RefusedError if the data were refused, the mirror cannot be held in the pump's range, or
    no candidate keeps the demands.
    """
    if quality.verdict == "refused":
        raise RefusedError("; ".join(quality.reasons))
    demands = demands or gain_search.Demands()
    model = identified.model
    if not 0 < model.holding_flow_um_per_s < pump.flow_full_um_per_s:
        raise RefusedError(
            f"the leak of {model.leak_um_per_s:.2f} µm/s is outside what the pump can hold: "
            "open the bleed or find the leak, then repeat"
        )
    settled = choose_feedforward(loop, disturbance)
    plants = sample_plants(identified, _PLANTS)

    def row(name: str, gains: closed_loop.Gains, around: LoopConfig) -> Candidate:
        made = evaluate_candidate(name, gains, model, disturbance, around, demands)
        step = demands.load_step_um_per_s
        spread = compute_half_widths(
            [compute_loop_figures(gains, plant, disturbance, around, step) for plant in plants]
        )
        if made.predicted is not None:
            weather_um = made.predicted.std_um * disturbance.unsteady
            spread = replace(spread, std_um=math.hypot(spread.std_um, weather_um))
        return replace(made, sigma=spread)

    designed = [
        row(name, gains, settled)
        for name, gains in compute_designs(model, disturbance, settled, demands).items()
    ]
    chosen = designed[0]
    # the search's grid is good to 1 %
    if not chosen.margins.stable or chosen.margins.ms > 1.02 * demands.ms:
        raise RefusedError(f"no gains achieve Ms <= {demands.ms:g} on this plant: reduce the delay")
    proposed = chosen.gains.applied_to(settled)
    return Proposal(
        loop=proposed,
        chosen=chosen,
        candidates=(chosen, row(PRESENT, closed_loop.Gains.from_config(loop), loop), *designed[1:]),
        least_std_um=lower_bound.compute_least_std_um(model, disturbance, settled),
        preview=preview_loop(proposed, pump, model, disturbance),
        robustness=evaluate_robustness(chosen.gains, identified, disturbance, settled),
    )
