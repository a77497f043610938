"""Turns identified models into a proposal: candidates side by side, their gains and costs, and the
proposed one.
"""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np
from pydantic import ValidationError
from rich.console import Group
from rich.table import Table

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from tuning.gains_file import MS_MAX
from tuning.identification import characterise, identify, loop_model
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal import candidates as rules
from tuning.proposal import prediction

# The Ziegler-Nichols relay on this loop sees a limit cycle where the phase is -180 deg, w d = pi /
# 2: Ku = pi / (2 k d), Tu = 4 d. Noise makes theirs even larger.
_RULE_FILTER_S = 0.2  # for rules that do not choose a filter, against the laser's noise
_PLANTS = 40  # drawn from the fit, for each candidate's error bars: 1 sigma to a tenth


def loop_figures(
    gains: loop_model.Gains,
    model: loop_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    step_um_per_s: float,
) -> loop_model.LoopFigures:
    """The figures on one plant; infinite for an unstable loop."""
    dt_s = disturbance.rest.dt_s
    ms = loop_model.sensitivity_peak(gains, model, dt_s)
    if not math.isfinite(ms):
        return loop_model.LoopFigures(math.inf, math.inf, math.inf, math.inf)
    answer = loop_model.load_step(gains, model, step_um_per_s, dt_s)
    return loop_model.LoopFigures(
        prediction.predict(gains, model, disturbance, loop).std_um,
        answer.peak_um,
        answer.recovery_s,
        ms,
    )


def half_widths(found: Sequence[loop_model.LoopFigures]) -> loop_model.LoopFigures:
    """Half of the central 68 % of each figure over many plants: 1 sigma; infinite if some of them
    are unstable.
    """
    rows = np.array([astuple(figures) for figures in found])
    low, high = np.quantile(rows, (0.16, 0.84), axis=0, method="nearest")
    with np.errstate(invalid="ignore"):  # infinite at both ends
        widths = np.where(np.isinf(high), np.inf, (high - low) / 2)
    return loop_model.LoopFigures(*widths.tolist())


# Evaluates a proposal on plants permitted by the data, drawn from the covariance of the fit.


@dataclass(frozen=True, slots=True)
class Robustness:
    """Over the sampled plants: 95 % quantiles of sensitivity and standard deviation, and share of
    stable loops.
    """

    ms_p95: float
    std_p95_um: float
    stable_fraction: float


def sampled_plants(
    identified: identify.Identified, count: int, seed: int = 1
) -> list[loop_model.PlantModel]:
    """Plants drawn from the fit's covariance; times and gain stay positive."""
    model = identified.model
    centre = np.array([model.gain, model.dead_time_s, model.lag_s, model.leak_um_per_s])
    draws = np.random.default_rng(seed).multivariate_normal(centre, identified.covariance, count)
    floor = np.array([0.05 * model.gain, 0.0, 1e-3, 0.0])
    return [loop_model.PlantModel(*row) for row in np.maximum(draws, floor).tolist()]


def robustness(
    gains: loop_model.Gains,
    identified: identify.Identified,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    count: int = 60,
) -> Robustness:
    """Evaluate gains on sampled plants; an unstable one counts as infinitely bad."""
    plants = sampled_plants(identified, count)
    dt_s = disturbance.rest.dt_s
    peaks = np.array([loop_model.sensitivity_peak(gains, plant, dt_s) for plant in plants])
    stable = np.isfinite(peaks)
    stds = np.array(
        [
            prediction.predict(gains, p, disturbance, loop).std_um if ok else np.inf
            for p, ok in zip(plants, stable, strict=True)
        ]
    )
    # the next value above: interpolating between a number and infinity is impossible
    peak_p95, std_p95 = (
        float(np.quantile(values, 0.95, method="higher")) for values in (peaks, stds)
    )
    return Robustness(peak_p95, std_p95, float(stable.mean()))


@dataclass(frozen=True, slots=True)
class Candidate:
    """One row of the table."""

    name: str
    gains: loop_model.Gains
    margins: loop_model.Margins
    predicted: prediction.Predicted | None  # None for an unstable loop
    ratio: float  # predicted standard deviation over the least possible
    # After the demanded step of the leak: largest excursion, and duration
    load_peak_um: float
    load_recovery_s: float
    # Of the figures, from the fit's covariance; of the standard deviation, also from how steady the
    # weather was
    sigma: loop_model.LoopFigures | None = None

    @property
    def figures(self) -> loop_model.LoopFigures:
        """What is compared with the other candidates."""
        std_um = self.predicted.std_um if self.predicted is not None else math.inf
        return loop_model.LoopFigures(
            std_um, self.load_peak_um, self.load_recovery_s, self.margins.ms
        )


@dataclass(frozen=True, slots=True)
class Proposal:
    """The tuner's proposal, with its reasons."""

    loop: LoopConfig  # the configuration with the proposed gains and feed-forward
    chosen: Candidate
    candidates: tuple[Candidate, ...]  # including the chosen one and the present gains
    least_std_um: float  # the lower bound
    preview: prediction.Preview  # of the chosen one on the fitted twin
    robustness: Robustness


class RefusedError(Exception):
    """The data do not support a proposal; the message says why and which experiment would help."""


def feedforward_settings(loop: LoopConfig, disturbance: DisturbanceModel) -> LoopConfig:
    """The loop with the fitted weather gains where the data determine
    them (`WeatherGain.agreed`).
    """
    changed: dict[str, float] = {}
    if disturbance.barometer is not None:
        changed["barometer_gain_um_per_pa"] = disturbance.barometer.agreed(
            loop.barometer_gain_um_per_pa
        )
    if disturbance.air is not None:
        changed["temperature_gain_um_per_k"] = disturbance.air.agreed(
            loop.temperature_gain_um_per_k
        )
    rounded = {name: float(f"{value:.4g}") for name, value in changed.items()}
    return LoopConfig.model_validate(loop.model_dump() | rounded)


def relay_ultimate(model: loop_model.PlantModel, dt_s: float) -> tuple[float, float]:
    """Ultimate gain in 1/s and period in s of the integrator with delay: Ku = pi / (2 k d), Tu = 4
    d.
    """
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
    predicted = prediction.predict(gains, model, disturbance, loop) if found.stable else None
    if predicted is not None and predicted.flow_std_um_per_s > loop.flow_max_um_per_s:
        predicted = replace(
            predicted, std_um=math.nan
        )  # the pump only switches: no linear loop describes that
    ratio = (
        predicted.std_um / prediction.least_std_um(model, disturbance, loop)
        if predicted is not None
        else math.inf
    )
    answer = loop_model.load_step(gains, model, demands.load_step_um_per_s, disturbance.rest.dt_s)
    return Candidate(name, gains, found, predicted, ratio, answer.peak_um, answer.recovery_s)


# What `tune run --choose` accepts; `SAME_LOAD` is there if the proposal answers a step of the leak
# worse than the present gains.
PRESENT, SAME_LOAD = "present", "same-load"
NAMES = (
    "least-variance",
    SAME_LOAD,
    "simc",
    "simc-slow",
    "amigo",
    "lambda",
    "max-ki",
    "ziegler-nichols",
)


def designs(
    model: loop_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    demands: rules.Demands,
) -> dict[str, loop_model.Gains]:
    """Gains by the name of their design (`NAMES`), the proposed ones first."""
    dt_s, filter_s = disturbance.rest.dt_s, _RULE_FILTER_S
    delay_s = rules.effective_delay_s(model, dt_s, filter_s)
    found = {"least-variance": rules.least_variance(model, disturbance, loop, demands)}
    step_um_per_s, present = demands.load_step_um_per_s, loop_model.Gains.of(loop)
    if math.isfinite(loop_model.sensitivity_peak(present, model, dt_s)):
        answer = loop_model.load_step(present, model, step_um_per_s, dt_s)
        if (
            loop_model.load_step(found["least-variance"], model, step_um_per_s, dt_s).peak_um
            > answer.peak_um
        ):
            kept = replace(demands, as_good_as=answer)
            found[SAME_LOAD] = rules.least_variance(model, disturbance, loop, kept)
    found |= {
        "simc": rules.simc(model, dt_s, filter_s),
        "simc-slow": rules.simc(model, dt_s, filter_s, 4 * delay_s),
        "amigo": rules.amigo(model, dt_s, filter_s),
        "lambda": rules.lambda_tuned(model, dt_s, filter_s),
        "max-ki": rules.max_ki(model, dt_s, filter_s, demands.ms),
        "ziegler-nichols": rules.ziegler_nichols(*relay_ultimate(model, dt_s)),
    }
    return {name: gains.rounded() for name, gains in found.items()}


def propose(
    identified: identify.Identified,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    pump: PumpConfig,
    quality: characterise.FitQuality,
    demands: rules.Demands | None = None,
) -> Proposal:
    """Design on identified data.

    Raises RefusedError if the data were refused, the mirror cannot be held in the pump's range, or
    no candidate keeps the demands.
    """
    if quality.verdict == "refused":
        raise RefusedError("; ".join(quality.reasons))
    demands = demands or rules.Demands()
    model = identified.model
    if not 0 < model.holding_flow_um_per_s < pump.flow_full_um_per_s:
        raise RefusedError(
            f"the leak of {model.leak_um_per_s:.2f} µm/s is outside what the pump can hold: "
            "open the bleed or find the leak, then repeat"
        )
    settled = feedforward_settings(loop, disturbance)
    plants = sampled_plants(identified, _PLANTS)

    def row(name: str, gains: loop_model.Gains, around: LoopConfig) -> Candidate:
        made = candidate(name, gains, model, disturbance, around, demands)
        step = demands.load_step_um_per_s
        spread = half_widths(
            [loop_figures(gains, plant, disturbance, around, step) for plant in plants]
        )
        if made.predicted is not None:
            weather_um = made.predicted.std_um * disturbance.unsteady
            spread = replace(spread, std_um=math.hypot(spread.std_um, weather_um))
        return replace(made, sigma=spread)

    designed = [
        row(name, gains, settled)
        for name, gains in designs(model, disturbance, settled, demands).items()
    ]
    chosen = designed[0]
    if (
        not chosen.margins.stable or chosen.margins.ms > 1.02 * demands.ms
    ):  # the search's grid is good to 1 %
        raise RefusedError(f"no gains achieve Ms <= {demands.ms:g} on this plant: reduce the delay")
    proposed = chosen.gains.applied_to(settled)
    return Proposal(
        loop=proposed,
        chosen=chosen,
        candidates=(chosen, row(PRESENT, loop_model.Gains.of(loop), loop), *designed[1:]),
        least_std_um=prediction.least_std_um(model, disturbance, settled),
        preview=prediction.preview(proposed, pump, model, disturbance),
        robustness=robustness(chosen.gains, identified, disturbance, settled),
    )


HEADS = (
    "candidate",
    "K 1/s",
    "Ti s",
    "filter s",
    "std µm",
    "load peak µm",
    "recovery s",
    "Ms",
    "against present",
)
MARGIN_HEADS = ("Td s", "/ least", "flow std µm/s", "GM", "PM deg", "delay margin s", "disk margin")
_WORDS = {"std_um": "std", "load_peak_um": "load peak", "load_recovery_s": "recovery", "ms": "Ms"}
_DIGITS = {"std_um": 3, "load_peak_um": 2, "load_recovery_s": 1, "ms": 2}
_ALIKE = 0.02  # a smaller change is none


def cells(rows: tuple[Candidate, ...]) -> list[tuple[str, ...]]:
    """The cells under `HEADS`, the present gains first."""
    present = next((row for row in rows if row.name == PRESENT), None)
    ordered = sorted(rows, key=lambda row: row is not present)
    return [(row.name, *_gains(row), *_figures(row), against(row, present)) for row in ordered]


def table(rows: tuple[Candidate, ...]) -> str:
    """The candidates as a Markdown table, with all margins."""
    heads = (*HEADS, *MARGIN_HEADS)
    margins = {row.name: _margins(row) for row in rows}
    lines = [
        heads,
        ("---", *["---:"] * (len(heads) - 1)),
        *((*line, *margins[line[0]]) for line in cells(rows)),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def shown(rows: tuple[Candidate, ...], title: str, leak_um_per_s: float) -> Group:
    """The candidates for a terminal of 80 columns; `leak_um_per_s` is what the mirror loses now."""
    figures = Table(title=title, box=None, padding=(0, 1, 0, 0))
    words = Table("", "against the present gains", box=None, padding=(0, 1, 0, 0))
    for number, head in enumerate(HEADS[:-1]):
        figures.add_column(
            "\n".join(head.rsplit(" ", 1)), justify="right" if number else "left", no_wrap=True
        )
    for line in cells(rows):
        figures.add_row(*(cell.replace(" +- ", "+-") for cell in line[:-1]))
        words.add_row(line[0], line[-1])
    step = rules.Demands().load_step_um_per_s
    caption = (
        f"Load peak and recovery: after the leak grows from {leak_um_per_s:.2f} to "
        f"{leak_um_per_s + step:.2f} µm/s. "
        "+-: 1 sigma of the fit; for std with ten other minutes of weather like the "
        "observed, which change every std "
        "alike."
    )
    return Group(figures, "", words, "", caption)


def against(row: Candidate, present: Candidate | None) -> str:
    """What gets better and what gets worse than with the present gains, as factors; or why it is
    not offered.
    """
    if row is present:
        return "in force"
    if why := refusal(row):
        return f"not offered: {why}"
    if present is None or present.predicted is None:
        return "the present gains are unstable"
    better: list[str] = []
    worse: list[str] = []
    for name, word in _WORDS.items():
        now, then = getattr(present.figures, name), getattr(row.figures, name)
        if not math.isnan(now - then) and not math.isclose(now, then, rel_tol=_ALIKE):
            factor = f" x {then / now:.2f}" if 0 < now < math.inf and then < math.inf else ""
            (better if then < now else worse).append(word + factor)
    return "; ".join(
        f"{word}: {', '.join(said)}"
        for word, said in (("better", better), ("worse", worse))
        if said
    )


def refusal(row: Candidate) -> str:
    """Why these gains must not be applied; empty if they may."""
    if row.predicted is None:
        return "unstable"
    if row.margins.ms > MS_MAX:
        return f"Ms {row.margins.ms:.2f}, the limit is {MS_MAX:g}"
    if math.isnan(row.predicted.std_um):
        return "the pump would only switch"
    try:
        row.gains.applied_to(LoopConfig())
    except ValidationError:
        return "outside the range of the configuration"
    return ""


def _gains(row: Candidate) -> tuple[str, ...]:
    gains = row.gains
    return f"{gains.kp_per_s:.3f}", f"{gains.ti_s:.2f}", f"{gains.filter_s:.2f}"


def _figures(row: Candidate) -> list[str]:
    if row.predicted is None:
        return ["unstable", "", "", ""]
    return [_figure(row, name, digits) for name, digits in _DIGITS.items()]


def _figure(row: Candidate, name: str, digits: int) -> str:
    value = float(getattr(row.figures, name))
    if math.isnan(value):
        return "not known"
    sigma = "" if row.sigma is None else f" +- {getattr(row.sigma, name):.{digits}f}"
    return f"{value:.{digits}f}{sigma}"


def _margins(row: Candidate) -> tuple[str, ...]:
    m, p = row.margins, row.predicted
    predicted = (f"{row.ratio:.2f}", f"{p.flow_std_um_per_s:.2f}") if p is not None else ("", "")
    margins = (
        f"{m.gain_margin:.1f}",
        f"{m.phase_margin_deg:.0f}",
        f"{m.delay_margin_s:.2f}",
        f"{m.disk_margin:.2f}",
    )
    return (f"{row.gains.td_s:.2f}", *predicted, *margins)
