"""Whether the data carry a proposal; if not, what was wrong with them and which experiment would help."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tuning.identify import Identified, independence, prediction_errors, whiteness
from tuning.records import Record
from tuning.straightness import two_gains

_LOST_MAX = 0.01
_GAIN_SIGMA_MAX = 0.10  # k beyond +-20 % (2 sigma) moves Ms and the variance by more than designs differ
_GAIN_SIGMA_GOOD = 0.03
_DELAY_SIGMA_MAX_S = 0.1
_UNANSWERED = 5.0  # k below this many standard errors: the pump did nothing that could be told from the weather
_JUMP_SIGMAS = 8.0  # of 10^4 residuals none is beyond 5
_P_MIN = 1e-4
_BENT_SIGMAS = 5.0  # sound benches show up to 2.7 in 192 sessions, pumps that saturate at 0.6 of the command 9
_BENT_SHARE = 0.2  # of k; less than that the margins bear
_WORSE_MAX = 1.5  # innovation on new data over that of the fit


@dataclass(frozen=True, slots=True)
class Quality:
    """Verdict on data and fit.

    Attributes
    ----------
    verdict : str
        "ok"; "degraded": usable, the uncertainty is larger than it should be; "refused": no proposal.
    reasons : tuple of str
        What was found, each with what would help.
    """

    verdict: Literal["ok", "degraded", "refused"]
    reasons: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Validation:
    """A fit on data that were not used for it.

    Attributes
    ----------
    innovation_ratio : float
        One-step prediction error there over that of the fit.
    whiteness_p, independence_p : float
        As in `Identified`.
    """

    innovation_ratio: float
    whiteness_p: float
    independence_p: float


def validate(identified: Identified, fresh: Record, settle_s: float = 2.0) -> Validation:
    """Predict a fresh record with a fitted model; the noise filter's start is left out."""
    errors = prediction_errors(
        fresh, identified.model, identified.noise, identified.pressure_gain_um_per_pa if fresh.has_barometer else 0.0
    )[round(settle_s / fresh.dt_s) :]
    change = np.diff(fresh.flow_um_per_s)[-errors.size :]
    return Validation(float(errors.std() / identified.innovation_um), whiteness(errors), independence(errors, change))


def judge(record: Record, identified: Identified, validation: Validation | None = None) -> Quality:
    """Verdict on a record and its fit."""
    refused, degraded = _faults(record, identified)
    if validation is not None and validation.innovation_ratio > _WORSE_MAX:
        degraded.append(
            f"new data are predicted {validation.innovation_ratio:.1f} times worse than those of the fit: "
            "the bench changed in between; repeat the relay in steadier weather"
        )
    if validation is not None and validation.independence_p < _P_MIN:
        degraded.append("the model leaves something of the flow in new data: repeat with the doublets experiment")
    verdict: Literal["ok", "degraded", "refused"] = "refused" if refused else "degraded" if degraded else "ok"
    return Quality(verdict, (*refused, *degraded))


def _faults(record: Record, identified: Identified) -> tuple[list[str], list[str]]:
    """What forbids a proposal, and what only widens its error bars."""
    model, sigma = identified.model, identified.sigma
    refused: list[str] = []
    degraded: list[str] = []
    if record.lost_fraction > _LOST_MAX:
        refused.append(f"{record.lost_fraction:.0%} of the laser's readings were lost: check the laser, repeat")
    if model.gain < _UNANSWERED * sigma.gain:
        refused.append(
            f"the mirror did not answer the pump (k = {model.gain:.2f} +- {sigma.gain:.2f}): run the pump map"
        )
        return refused, degraded
    if identified.largest_residual > _JUMP_SIGMAS:
        at_s = float(np.argmax(np.abs(identified.residual_um))) * record.dt_s
        refused.append(f"the mirror jumped at {at_s:.1f} s (a door?): repeat the relay")
    if sigma.gain > _GAIN_SIGMA_MAX * model.gain:
        refused.append(f"k is known to {sigma.gain / model.gain:.0%} only: run the relay for longer")
    elif sigma.gain > _GAIN_SIGMA_GOOD * model.gain:
        degraded.append(f"k is known to {sigma.gain / model.gain:.0%}: a longer relay would make it 3 %")
    if sigma.delay_s > _DELAY_SIGMA_MAX_S:
        refused.append(f"the delay is known to {sigma.delay_s:.2f} s only: run the doublets")
    refused.extend(_bent(record, identified))
    if identified.independence_p < _P_MIN:
        degraded.append("the residuals know the flow (a saturating or sticking pump?): run the pump map")
    if identified.whiteness_p < _P_MIN:
        degraded.append("the residuals are coloured: something periodic moves the mirror or the reading")
    return refused, degraded


def _bent(record: Record, identified: Identified) -> list[str]:
    """What is wrong if one gain does not do for both halves of the pump."""
    found = two_gains(record, identified)
    least = max(_BENT_SIGMAS * found.difference_sigma, _BENT_SHARE * identified.model.gain)
    if abs(found.above - found.below) < least:
        return []
    what = "the pump saturates" if found.above < found.below else "the pump stalls at small flows"
    gains = f"k = {found.below:.2f} below the holding flow and {found.above:.2f} above"
    return [f"{what} ({gains}): run the pump map and set [pump] from it"]
