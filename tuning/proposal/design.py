"""From what was identified to a proposal: all candidates side by side, and the one that is proposed."""

import math
from dataclasses import dataclass

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from tuning.identification import characterise, identify, loop_model
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal import candidates as rules
from tuning.proposal.prediction import Predicted, Robustness, least_std_um, predict, robustness
from tuning.proposal.preview import Preview, preview

# The hobby tuners' relay on this loop sees a limit cycle at the frequency where the phase is -180 deg, w d = pi / 2:
# Ku = pi / (2 k d), Tu = 4 d. Noise makes theirs larger still.
_RULE_FILTER_S = 0.2  # what the rules that do not choose a filter get, against the laser's noise


@dataclass(frozen=True, slots=True)
class Candidate:
    """One row of the table."""

    name: str
    gains: loop_model.Gains
    margins: loop_model.Margins
    predicted: Predicted | None  # None for an unstable loop
    ratio: float  # predicted standard deviation over the least possible
    # After the demanded step of the leak, by formula: furthest excursion, and how long until it is over
    load_peak_um: float
    load_recovery_s: float


@dataclass(frozen=True, slots=True)
class Proposal:
    """What the tuner proposes, and why."""

    loop: LoopConfig  # the configuration with the proposed gains and feed-forward
    chosen: Candidate
    candidates: tuple[Candidate, ...]  # all of them, the chosen one and the present gains included
    least_std_um: float  # the bound
    preview: Preview  # of the chosen one on the fitted twin
    robustness: Robustness


class RefusedError(Exception):
    """The data do not carry a proposal; the message says why and which experiment would help."""


def feedforward_settings(loop: LoopConfig, disturbance: DisturbanceModel) -> LoopConfig:
    """The loop with the fitted weather gains where the data know them (`WeatherGain.agreed`)."""
    changed: dict[str, float] = {}
    if disturbance.barometer is not None:
        changed["barometer_gain_um_per_pa"] = disturbance.barometer.agreed(loop.barometer_gain_um_per_pa)
    if disturbance.air is not None:
        changed["temperature_gain_um_per_k"] = disturbance.air.agreed(loop.temperature_gain_um_per_k)
    return LoopConfig.model_validate(loop.model_dump() | changed)


def relay_ultimate(model: loop_model.PlantModel, dt_s: float) -> tuple[float, float]:
    """Ultimate gain in 1/s and period in s of the integrator with delay: Ku = pi / (2 k d), Tu = 4 d."""
    delay_s = rules.effective_delay_s(model, dt_s, 0.0)
    return math.pi / (2 * model.gain * delay_s), 4 * delay_s


def candidate(
    name: str,
    gains: loop_model.Gains,
    model: loop_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    demands: rules.Demands,
) -> Candidate:
    """One row."""
    found = loop_model.margins(gains, model, disturbance.rest.dt_s)
    predicted = predict(gains, model, disturbance, loop) if found.stable else None
    ratio = predicted.std_um / least_std_um(model, disturbance, loop) if predicted is not None else math.inf
    step_um_per_s = demands.load_step_um_per_s
    peak_um, over_s = (
        rules.load_peak_um(gains, model, step_um_per_s),
        rules.load_recovery_s(gains, model, step_um_per_s),
    )
    return Candidate(name, gains, found, predicted, ratio, peak_um, over_s)


def candidates(
    model: loop_model.PlantModel, disturbance: DisturbanceModel, loop: LoopConfig, demands: rules.Demands
) -> tuple[Candidate, ...]:
    """All candidates; the first is the one to propose."""
    dt_s, filter_s = disturbance.rest.dt_s, _RULE_FILTER_S
    delay_s = rules.effective_delay_s(model, dt_s, filter_s)
    named = {
        f"least variance, Ms <= {demands.ms:g}": rules.least_variance(model, disturbance, loop, demands),
        "present": loop_model.Gains.of(loop),
        "SIMC, tc = delay": rules.simc(model, dt_s, filter_s),
        "SIMC, tc = 4 delays": rules.simc(model, dt_s, filter_s, 4 * delay_s),
        "AMIGO": rules.amigo(model, dt_s, filter_s),
        "lambda = 3 delays": rules.lambda_tuned(model, dt_s, filter_s),
        f"max ki, Ms <= {demands.ms:g}": rules.max_ki(model, dt_s, filter_s, demands.ms),
        "Ziegler-Nichols": rules.ziegler_nichols(*relay_ultimate(model, dt_s)),
    }
    return tuple(candidate(name, gains, model, disturbance, loop, demands) for name, gains in named.items())


def propose(
    identified: identify.Identified,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    pump: PumpConfig,
    quality: characterise.FitQuality,
    demands: rules.Demands | None = None,
) -> Proposal:
    """Design on identified data.

    Raises RefusedError if the data were refused, the mirror cannot be held in the pump's range, or no candidate keeps
    the demands.
    """
    if quality.verdict == "refused":
        raise RefusedError("; ".join(quality.reasons))
    demands = demands or rules.Demands()
    model = identified.model
    if not 0 < model.holding_flow_um_per_s < pump.flow_full_um_per_s:
        raise RefusedError(
            f"the leak of {model.leak_um_per_s:.2f} um/s is outside what the pump can hold: "
            "open the bleed or find the leak, then repeat"
        )
    settled = feedforward_settings(loop, disturbance)
    rows = candidates(model, disturbance, settled, demands)
    chosen = rows[0]
    if not chosen.margins.stable or chosen.margins.ms > 1.02 * demands.ms:  # the search's grid is good to 1 %
        raise RefusedError(f"no gains keep Ms <= {demands.ms:g} on this plant: a smaller delay is needed")
    proposed = chosen.gains.applied_to(settled)
    return Proposal(
        loop=proposed,
        chosen=chosen,
        candidates=rows,
        least_std_um=least_std_um(model, disturbance, settled),
        preview=preview(proposed, pump, model, disturbance),
        robustness=robustness(chosen.gains, identified, disturbance, settled),
    )


def table(rows: tuple[Candidate, ...]) -> str:
    """The candidates as a Markdown table."""
    head = (
        "| design | K 1/s | Ti s | Td s | filter s | std um | / least | flow std um/s | Ms | GM | PM deg "
        "| delay margin s | disk margin | load peak um | over after s |\n|---" + "|---:" * 14 + "|"
    )
    lines = [head]
    for row in rows:
        g, m, p = row.gains, row.margins, row.predicted
        std = f"{p.std_um:.3f} | {row.ratio:.2f} | {p.flow_std_um_per_s:.2f}" if p is not None else "unstable | | "
        lines.append(
            f"| {row.name} | {g.kp_per_s:.3f} | {g.ti_s:.2f} | {g.td_s:.2f} | {g.filter_s:.2f} | {std} | {m.ms:.2f} "
            f"| {m.gain_margin:.1f} | {m.phase_margin_deg:.0f} | {m.delay_margin_s:.2f} | {m.disk_margin:.2f} "
            f"| {row.load_peak_um:.2f} | {row.load_recovery_s:.1f} |"
        )
    return "\n".join(lines)
