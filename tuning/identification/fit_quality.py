"""Judges whether the data support a proposal; if not, names the problem and a remedy."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from membrane_ctrl.control.leak_estimate import TOO_TIGHT_UM_PER_S
from tuning.identification.plant_fit import Identified, compute_prediction_errors
from tuning.identification.record import Record
from tuning.identification.residual_tests import compute_independence_p, compute_whiteness_p
from tuning.identification.two_gains import fit_two_gains

MAP_THE_PUMP = "run `tune pump`"
LARGER_LIMIT = "repeat `tune characterise` with a larger --limit-um"
# On a tight mirror the flow may hardly fall below the leak, so a larger limit does not help. On the
# usual vent this adds 1 µm/s of leak.
_MORE_BLEED = 0.01
# Share of the readings. 6 % of them, lost singly or in gaps of 80 ms, move the fit by less than
# half a standard deviation
_LOST_MAX = 0.05
# An error of k beyond +-20 % (2 sigma) changes Ms and variance by more than designs differ.
_GAIN_SIGMA_MAX = 0.10
_GAIN_SIGMA_GOOD = 0.03
# Error of the delay, in s or as a share of the delay: a loop with a long delay is slow, and
# tolerates a larger error.
_DELAY_SIGMA_MAX_S = 0.1
_DELAY_SIGMA_SHARE = 0.1
_UNANSWERED = 5.0  # k below this many standard errors: the pump's effect is lost in the weather
JUMP_SIGMAS = 8.0  # of 10^4 residuals none is beyond 5
_P_MIN = 1e-4  # of a statistical test
# Sound benches show up to 2.7 in 192 sessions, pumps that saturate at 0.6 of the command 9.
_BENT_SIGMAS = 5.0
_BENT_SHARE = 0.2  # of k; the margins tolerate less
_STRONG = 1.5  # k of a pump whose least flow may be more than the leak: it swings with any gains
_REPEATED_MOST = 0.15  # of the readings; a sensor with steps of a quarter of its noise has 7 %
_WORSE_MAX = 1.5  # innovation on new data relative to the fit


def choose_remedy(leak_um_per_s: float) -> str:
    """Return what makes the parameters of the fit better known, for people.

    Parameters
    ----------
    leak_um_per_s : float
        Fitted leak, with the bleed as it is.
    """
    if leak_um_per_s >= TOO_TIGHT_UM_PER_S:
        return LARGER_LIMIT
    return (
        f"the mirror is tight (leak {leak_um_per_s:.2f} µm/s): make loop.bleed_fraction larger by "
        f"{_MORE_BLEED}, then repeat `tune characterise`"
    )


@dataclass(frozen=True, slots=True)
class FitQuality:
    """Verdict on data and fit."""

    # "ok"; "degraded": usable, the uncertainty is larger than it should be; "refused": no proposal
    verdict: Literal["ok", "degraded", "refused"]
    reasons: tuple[str, ...]  # the findings, each with a remedy
    pump_suspected: bool = False  # by one of them: the pump may not match its configured curve

    @property
    def pump_unknown(self) -> bool:
        """Refused because the pump does not match its configured curve."""
        return self.verdict == "refused" and self.pump_suspected


@dataclass(frozen=True, slots=True)
class FitFinding:
    """A problem of a record or its fit, with a remedy."""

    text: str
    pump_suspected: bool = False  # the remedy is to map the pump


def _suspect_pump(problem: str) -> FitFinding:
    return FitFinding(f"{problem}: {MAP_THE_PUMP}", pump_suspected=True)


@dataclass(frozen=True, slots=True)
class Validation:
    """A fit tested on data not used for it."""

    innovation_ratio: float  # one-step prediction error relative to the fit
    whiteness_p: float  # as in `Identified`
    independence_p: float


def validate_fit(identified: Identified, fresh: Record, settle_s: float = 2.0) -> Validation:
    """Predict a fresh record with a fitted model.

    Parameters
    ----------
    identified : Identified
        The fit.
    fresh : Record
        Data that were not used for it.
    settle_s : float
        Start-up of the noise's filter, which does not count.

    Returns
    -------
    Validation
    """
    pressure_gain_um_per_pa = 0.0
    if fresh.has_barometer:
        pressure_gain_um_per_pa = identified.pressure_gain_um_per_pa
    all_errors = compute_prediction_errors(
        fresh, identified.model, identified.noise, pressure_gain_um_per_pa
    )
    start = round(settle_s / fresh.dt_s)
    errors = all_errors[start:]
    change = np.diff(fresh.flow_um_per_s)[-errors.size :]
    return Validation(
        float(errors.std() / identified.innovation_um),
        compute_whiteness_p(errors),
        compute_independence_p(errors, change),
    )


def judge_fit(
    record: Record, identified: Identified, validation: Validation | None = None
) -> FitQuality:
    """Judge a record and its fit.

    Parameters
    ----------
    record : Record
        The data.
    identified : Identified
        The fit to them.
    validation : Validation, optional
        Its prediction of other data.

    Returns
    -------
    FitQuality
    """
    # Findings of the fit, and of its prediction of other data.
    refused, degraded = _list_findings(record, identified)
    if validation is not None and validation.innovation_ratio > _WORSE_MAX:
        worse = (
            f"new data are predicted {validation.innovation_ratio:.1f} times worse than those of "
            "the fit"
        )
        degraded.append(
            FitFinding(
                f"{worse}: the bench changed in between; repeat the relay in steadier weather"
            )
        )
    if validation is not None and validation.independence_p < _P_MIN:
        degraded.append(
            FitFinding("new residuals still follow the flow: repeat with the doublets experiment")
        )
    # The worst of them.
    verdict: Literal["ok", "degraded", "refused"] = "ok"
    if refused:
        verdict = "refused"
    elif degraded:
        verdict = "degraded"
    findings = (*refused, *degraded)
    texts = tuple(finding.text for finding in findings)
    return FitQuality(verdict, texts, any(finding.pump_suspected for finding in findings))


def _list_findings(
    record: Record, identified: Identified
) -> tuple[list[FitFinding], list[FitFinding]]:
    """Findings that forbid a proposal, and those that only widen its error bars."""
    model, sigma = identified.model, identified.sigma
    refused: list[FitFinding] = []
    degraded: list[FitFinding] = []
    # Is there a record, and does it show an answer?
    if record.lost_fraction > _LOST_MAX:
        lost = f"{record.lost_fraction:.0%} of the readings were lost"
        refused.append(FitFinding(f"{lost}: check the laser (without one, the camera), repeat"))
    if model.gain < _UNANSWERED * sigma.gain:
        known = f"k = {model.gain:.2f} +- {sigma.gain:.2f}"
        refused.append(_suspect_pump(f"the mirror did not answer the pump ({known})"))
        return refused, degraded
    # Jumps, and parameters that are hardly known.
    remedy = choose_remedy(model.leak_um_per_s)
    if identified.largest_residual > JUMP_SIGMAS:
        at_s = float(np.argmax(np.abs(identified.residual_um))) * record.dt_s
        refused.append(FitFinding(f"the mirror jumped at {at_s:.1f} s (a door?): repeat the relay"))
    if sigma.gain > _GAIN_SIGMA_MAX * model.gain:
        refused.append(FitFinding(f"k is known to {sigma.gain / model.gain:.0%} only: {remedy}"))
    elif sigma.gain > _GAIN_SIGMA_GOOD * model.gain:
        degraded.append(
            FitFinding(
                f"k is known to {sigma.gain / model.gain:.0%}: a longer relay would make it 3 %"
            )
        )
    if sigma.delay_s > max(_DELAY_SIGMA_MAX_S, _DELAY_SIGMA_SHARE * model.delay_s):
        refused.append(FitFinding(f"the delay is known to {sigma.delay_s:.2f} s only: {remedy}"))
    # One gain for the whole range of the pump?
    refused.extend(find_bent_curve(record, identified))
    # Residuals of the right model are white, and independent of the flow.
    if identified.independence_p < _P_MIN:
        degraded.append(
            _suspect_pump("the residuals follow the flow (a saturating or sticking pump?)")
        )
    if identified.whiteness_p < _P_MIN and model.gain > _STRONG:
        coloured = f"k = {model.gain:.2f}, and the residuals are coloured (a sticking pump?)"
        refused.append(_suspect_pump(coloured))
    elif identified.whiteness_p < _P_MIN:
        degraded.append(FitFinding(f"the residuals are coloured: {_explain_colour(record)}"))
    return refused, degraded


def _explain_colour(record: Record) -> str:
    """What may colour the residuals; the sensor first, where it repeats its readings."""
    steps_um = np.diff(record.displacement_um[np.isfinite(record.displacement_um)])
    repeated = float(np.mean(steps_um == 0.0)) if steps_um.size else 0.0
    if repeated > _REPEATED_MOST:
        return (
            f"{repeated:.0%} of the readings repeat the one before, so that the sensor is slower "
            "than the ticks or its steps are coarse"
        )
    return "something periodic moves the mirror or the reading, or the weather is no random walk"


def find_bent_curve(record: Record, identified: Identified) -> list[FitFinding]:
    """Find whether one gain describes both halves of the pump's range.

    Parameters
    ----------
    record : Record
        Readings and commanded flow of the experiments.
    identified : Identified
        The plant that was fitted to them.

    Returns
    -------
    list of FitFinding
        One finding if the two gains differ beyond their errors and by more than a share; else none.
    """
    found = fit_two_gains(record, identified)
    least = max(_BENT_SIGMAS * found.difference_sigma, _BENT_SHARE * identified.model.gain)
    if abs(found.above - found.below) < least:
        return []
    cause = "the pump stalls at small flows"
    if found.above < found.below:
        cause = "the pump saturates"
    gains = f"k = {found.below:.2f} below the holding flow and {found.above:.2f} above"
    return [_suspect_pump(f"{cause} ({gains})")]
