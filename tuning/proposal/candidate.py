"""One candidate: gains with their margins, figures and cost."""

import math
from dataclasses import dataclass, replace

from pydantic import ValidationError

from membrane_ctrl.config.schema import LoopConfig
from tuning.gains_file import MS_MAX
from tuning.identification import closed_loop, load_step, loop_figures, plant_model
from tuning.identification.disturbance import DisturbanceModel
from tuning.identification.margins import Margins, compute_margins
from tuning.proposal import gain_search, lower_bound, prediction

# What `tune run --choose` accepts. `BALANCED` is there if `LEAST_VARIANCE` lets a step of the leak
# move the centre too far beyond what the present gains let it, `SAME_LOAD` if it answers that step
# worse than they do. The proposal is the first of those that are there.
PRESENT = "present"
BALANCED = "balanced"
LEAST_VARIANCE = "least-variance"
SAME_LOAD = "same-load"
NAMES = (
    BALANCED,
    LEAST_VARIANCE,
    SAME_LOAD,
    "simc",
    "simc-slow",
    "amigo",
    "lambda",
    "max-ki",
    "ziegler-nichols",
)


@dataclass(frozen=True, slots=True)
class Candidate:
    """One row of the table."""

    name: str
    gains: closed_loop.Gains
    margins: Margins
    predicted: prediction.Predicted | None  # None for an unstable loop
    ratio: float  # predicted standard deviation over the least possible
    # After the demanded step of the leak: largest excursion, and duration
    load_peak_um: float
    load_recovery_s: float
    # Of the figures, from the fit's covariance; of the standard deviation, also from how steady the
    # weather was
    sigma: loop_figures.LoopFigures | None = None

    @property
    def figures(self) -> loop_figures.LoopFigures:
        """What is compared with the other candidates."""
        std_um = math.inf
        if self.predicted is not None:
            std_um = self.predicted.std_um
        return loop_figures.LoopFigures(
            std_um, self.load_peak_um, self.load_recovery_s, self.margins.ms
        )


def evaluate_candidate(
    name: str,
    gains: closed_loop.Gains,
    model: plant_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    demands: gain_search.Demands,
) -> Candidate:
    """Evaluate gains: their margins, their predicted figures, and their answer to a step.

    Parameters
    ----------
    name : str
        Of the candidate.
    gains : Gains
        Of the candidate.
    model : PlantModel
        The identified plant.
    disturbance : DisturbanceModel
        Noise of the readings, and weather.
    loop : LoopConfig
        Its feed-forward and the limits of its flow.
    demands : Demands
        Its step of the leak.

    Returns
    -------
    Candidate
        Without error bars.
    """
    dt_s = disturbance.rest.dt_s
    margins = compute_margins(gains, model, dt_s)

    # The prediction of a stable loop, against the least that any controller reaches.
    predicted = None
    ratio = math.inf
    if margins.stable:
        predicted = prediction.predict_loop(gains, model, disturbance, loop)
        if predicted.flow_std_um_per_s > loop.flow_max_um_per_s:
            # The pump only switches: no linear loop describes that.
            predicted = replace(predicted, std_um=math.nan)
        ratio = predicted.std_um / lower_bound.compute_least_std_um(model, disturbance, loop)

    answer = load_step.simulate_load_step(gains, model, demands.load_step_um_per_s, dt_s)
    return Candidate(name, gains, margins, predicted, ratio, answer.peak_um, answer.recovery_s)


def find_refusal(row: Candidate) -> str:
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
