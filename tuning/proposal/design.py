"""Turns identified models into a proposal: all candidates side by side, and the proposed one."""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control import gas
from membrane_ctrl.control.experiments.machine import BenchSample
from tuning.identification import characterise, identify, loop_model, records
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal import candidates as rules
from tuning.proposal import prediction
from tuning.rig import Rig

# The fitted plant as a bench: previews a proposal with the real one-sided pump before anything is applied.
#
# Linear prediction ignores that the pump only adds gas, stalls and starts. Here the real loop drives a pump
# with the configured curve in front of the identified delay, lag, gain and leak, in the identified weather.

_SUBSTEPS = 4  # per tick: resolves a dead time to 2.5 ms at 50 Hz
_SETTLE_S = 30.0
_LEVEL_PA, _LEVEL_C = 101_325.0, 23.0  # arbitrary: only changes matter


class ModelBench:
    """A simulated bench made from the identified models; equal seeds give equal weather.

    `leak_step` has the time in s and the size in um/s of a step of the leak.
    """

    def __init__(
        self,
        model: loop_model.PlantModel,
        disturbance: DisturbanceModel,
        pump: PumpConfig,
        seed: int,
        leak_step: tuple[float, float] = (math.inf, 0.0),
    ) -> None:
        self._model, self._disturbance, self._pump = model, disturbance, pump
        self._curve = gas.branch(pump, pump.curve_um_per_s)
        self._leak_step = leak_step
        self._rng = np.random.default_rng(seed)
        self._dt_s = disturbance.rest.dt_s
        self._step_s = self._dt_s / _SUBSTEPS
        flow = model.holding_flow_um_per_s
        self._tube = deque([flow] * (1 + round(model.dead_time_s / self._step_s)))
        self._arriving = flow
        self._running = True
        self._way_um = 0.0
        self._walks = prediction.Walks.of(disturbance)
        self._transition, kicks = self._walks.over(self._dt_s)
        sizes, ways = np.linalg.eigh(kicks)
        self._kicks = ways * np.sqrt(np.maximum(sizes, 0.0))
        self._weather = np.zeros(len(kicks))
        self._ticks = 0
        self.true_um: list[float] = []

    def exchange(self, pump_fraction: float, vent_fraction: float) -> BenchSample:
        """Run one tick. The vent is assumed as during the identification of the leak."""
        pump = self._pump
        self._running = pump_fraction >= (pump.stall_fraction if self._running else pump.start_fraction)
        flow = self._curve.flow(pump_fraction) if self._running else 0.0
        at_s, size = self._leak_step
        leak = self._model.leak_um_per_s + (size if self._ticks * self._dt_s >= at_s else 0.0)
        follow = -math.expm1(-self._step_s / self._model.lag_s)
        for _ in range(_SUBSTEPS):
            self._tube.append(flow)
            self._arriving += (self._tube.popleft() - self._arriving) * follow
            self._way_um += (self._model.gain * self._arriving - leak) * self._step_s
        self._weather = self._transition @ self._weather + self._kicks @ self._rng.standard_normal(self._weather.size)
        return self._read()

    def _read(self) -> BenchSample:
        of, walks = self._disturbance, self._walks
        true_um = self._way_um + float(walks.centre @ self._weather)
        self.true_um.append(true_um)
        self._ticks += 1
        laser, pressure, temperature = self._rng.standard_normal(3).tolist()
        return BenchSample(
            true_um + of.laser_um * laser,
            _LEVEL_PA + float(walks.barometer @ self._weather) + of.barometer.noise * pressure
            if of.barometer
            else math.nan,
            _LEVEL_C + float(walks.air @ self._weather) + of.air.noise * temperature if of.air else math.nan,
        )


@dataclass(frozen=True, slots=True)
class Preview:
    """Result on the fitted twin."""

    std_um: float  # of the true centre
    bias_um: float  # target minus true centre
    # After a step of the leak, weather off: furthest excursion, and time until the centre stays within `RECOVERED_UM`
    load_peak_um: float
    recovery_s: float


def preview(
    loop: LoopConfig,
    pump: PumpConfig,
    model: loop_model.PlantModel,
    disturbance: DisturbanceModel,
    seed: int = 1,
    duration_s: float = 180.0,
    load_step_um_per_s: float = 0.6,
) -> Preview:
    """Hold on the fitted twin in its weather, and once more without weather for a step of the leak."""
    true_um = _held(loop, pump, model, ModelBench(model, disturbance, pump, seed), duration_s)
    noise = replace(disturbance.rest, white=disturbance.rest.white * 1e-3, fast=0.0, slow=0.0, coloured=())
    calm = DisturbanceModel(noise, None, None)
    stepped = ModelBench(model, calm, pump, seed, (_SETTLE_S, load_step_um_per_s))
    answer_um = _held(loop, pump, model, stepped, 120.0)
    away = np.flatnonzero(np.abs(answer_um) > loop_model.RECOVERED_UM)
    return Preview(
        std_um=float(true_um.std()),
        bias_um=-float(true_um.mean()),
        load_peak_um=float(np.abs(answer_um).max()),
        recovery_s=float((away[-1] + 1) / loop.rate_hz) if away.size else 0.0,
    )


def _held(
    loop: LoopConfig, pump: PumpConfig, model: loop_model.PlantModel, bench: ModelBench, duration_s: float
) -> records.Series:
    """True centre after settling."""
    rig = Rig(bench, loop, pump, model.holding_flow_um_per_s)
    rig.hold(_SETTLE_S + duration_s)
    return np.array(bench.true_um)[round(_SETTLE_S * loop.rate_hz) :]


# The Ziegler-Nichols relay on this loop sees a limit cycle where the phase is -180 deg, w d = pi / 2:
# Ku = pi / (2 k d), Tu = 4 d. Noise makes theirs even larger.
_RULE_FILTER_S = 0.2  # for rules that do not choose a filter, against the laser's noise
_PLANTS = 40  # drawn from the fit, for each candidate's error bars: 1 sigma to a tenth


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
    # Of the figures, from the fit's covariance; of the standard deviation, also from how steady the weather was
    sigma: loop_model.LoopFigures | None = None

    @property
    def figures(self) -> loop_model.LoopFigures:
        """What is compared with the other candidates."""
        std_um = self.predicted.std_um if self.predicted is not None else math.inf
        return loop_model.LoopFigures(std_um, self.load_peak_um, self.load_recovery_s, self.margins.ms)


@dataclass(frozen=True, slots=True)
class Proposal:
    """The tuner's proposal, with its reasons."""

    loop: LoopConfig  # the configuration with the proposed gains and feed-forward
    chosen: Candidate
    candidates: tuple[Candidate, ...]  # including the chosen one and the present gains
    least_std_um: float  # the lower bound
    preview: Preview  # of the chosen one on the fitted twin
    robustness: prediction.Robustness


class RefusedError(Exception):
    """The data do not support a proposal; the message says why and which experiment would help."""


def feedforward_settings(loop: LoopConfig, disturbance: DisturbanceModel) -> LoopConfig:
    """The loop with the fitted weather gains where the data determine them (`WeatherGain.agreed`)."""
    changed: dict[str, float] = {}
    if disturbance.barometer is not None:
        changed["barometer_gain_um_per_pa"] = disturbance.barometer.agreed(loop.barometer_gain_um_per_pa)
    if disturbance.air is not None:
        changed["temperature_gain_um_per_k"] = disturbance.air.agreed(loop.temperature_gain_um_per_k)
    rounded = {name: float(f"{value:.4g}") for name, value in changed.items()}
    return LoopConfig.model_validate(loop.model_dump() | rounded)


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
    predicted = prediction.predict(gains, model, disturbance, loop) if found.stable else None
    ratio = (
        predicted.std_um / prediction.least_std_um(model, disturbance, loop) if predicted is not None else math.inf
    )
    answer = loop_model.load_step(gains, model, demands.load_step_um_per_s, disturbance.rest.dt_s)
    return Candidate(name, gains, found, predicted, ratio, answer.peak_um, answer.recovery_s)


# What `tune run --choose` accepts; `SAME_LOAD` is there if the proposal answers a step of the leak worse than the
# present gains.
PRESENT, SAME_LOAD = "present", "same-load"
NAMES = ("least-variance", SAME_LOAD, "simc", "simc-slow", "amigo", "lambda", "max-ki", "ziegler-nichols")


def designs(
    model: loop_model.PlantModel, disturbance: DisturbanceModel, loop: LoopConfig, demands: rules.Demands
) -> dict[str, loop_model.Gains]:
    """Gains by the name of their design (`NAMES`), the proposed ones first."""
    dt_s, filter_s = disturbance.rest.dt_s, _RULE_FILTER_S
    delay_s = rules.effective_delay_s(model, dt_s, filter_s)
    found = {"least-variance": rules.least_variance(model, disturbance, loop, demands)}
    step_um_per_s, present = demands.load_step_um_per_s, loop_model.Gains.of(loop)
    if math.isfinite(loop_model.sensitivity_peak(present, model, dt_s)):
        answer = loop_model.load_step(present, model, step_um_per_s, dt_s)
        if loop_model.load_step(found["least-variance"], model, step_um_per_s, dt_s).peak_um > answer.peak_um:
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
    plants = prediction.sampled_plants(identified, _PLANTS)

    def row(name: str, gains: loop_model.Gains, around: LoopConfig) -> Candidate:
        made = candidate(name, gains, model, disturbance, around, demands)
        step = demands.load_step_um_per_s
        spread = prediction.half_widths(
            [prediction.loop_figures(gains, plant, disturbance, around, step) for plant in plants]
        )
        if made.predicted is not None:
            weather_um = made.predicted.std_um * disturbance.unsteady
            spread = replace(spread, std_um=math.hypot(spread.std_um, weather_um))
        return replace(made, sigma=spread)

    designed = [row(name, gains, settled) for name, gains in designs(model, disturbance, settled, demands).items()]
    chosen = designed[0]
    if not chosen.margins.stable or chosen.margins.ms > 1.02 * demands.ms:  # the search's grid is good to 1 %
        raise RefusedError(f"no gains achieve Ms <= {demands.ms:g} on this plant: reduce the delay")
    proposed = chosen.gains.applied_to(settled)
    return Proposal(
        loop=proposed,
        chosen=chosen,
        candidates=(chosen, row(PRESENT, loop_model.Gains.of(loop), loop), *designed[1:]),
        least_std_um=prediction.least_std_um(model, disturbance, settled),
        preview=preview(proposed, pump, model, disturbance),
        robustness=prediction.robustness(chosen.gains, identified, disturbance, settled),
    )
